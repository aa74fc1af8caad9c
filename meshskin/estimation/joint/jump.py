"""A jump or a steady drift of all contacts in the course of a recording, as of a body that was
mounted anew, or of a skin that creeps.

Taxels that are touched before and after it show it: others are displaced with their contacts.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from ...core import se3
from ...core.arrays import Array, huber_cost, robust_sigma
from .departures import FittedReadings, fitted_readings, normal_score
from .fault_detection import CUTOFF, outliers
from .joint_estimator import JointEstimator
from .pressure import OBSERVED
from .readings import Readings

JUMP = "a jump of the contacts"
MIN_JUMP = 5.0
"""Score from which a jump is shown. It is relative to what groups of contacts or other places tell,
so that errors that neighbouring contacts share are in it already. Of 42 sound logs the largest is
4.0, of 22 in which the body was displaced or turned the least is 5.9."""
PLACES = 15
"""Places in a recording, evenly spaced, where a jump is looked for."""
PERIODS, GROUP = 30, 2.0
"""Parts of a recording, and size of a part of the body in reaches of a contact, over which errors
that neighbouring contacts share are summed."""
APART, MIN_PLACES = 0.1, 5
"""Part of the recording between a jump and other places whose scores it is compared with, and their
least number."""
TOGETHER = 3
"""Places whose displacements are solved for together: more need the memory of the contacts' again.
"""
MIN_SHOWN = 0.02
"""Information on a direction of a jump, relative to the best known one, from which it is estimated:
that along the normals is near zero."""
MIN_TAXELS, MIN_OUTLYING, MIN_RATIO = 3, 2, 4
"""Taxels, at least, with an outlying side by which a jump is estimated; outlying readings of each
there, and their number relative to those on its other side: beside a jump of 0.5 mm 7 to 12 taxels
of 69 had 3 to 6 of 45, and a tenth of them were on the other side by chance."""
MAX_PLACES, NEAR_BEST = 100, 0.7
"""Places where outlying readings may be divided, and the number of those divided, relative to the
largest, from which a jump is estimated there: between two of them other readings tell the place."""
MIN_EXPLAINED = 0.5
"""Part of the squared residuals, each cut, that a jump must explain: of ids that are permuted from
one contact on a displacement explains 0.06."""
MAX_STEPS, MAX_STEP, DAMPING, TOLERANCE = 30, 1e-3, 1e-3, 1e-3
"""Steps, at most, by which the displacement is estimated, and their length, m; first damping, and
relative decrease of the cost at which it has converged: its score tells, not its last digits."""


@dataclass(frozen=True)
class Jump:
    """A displacement of all contacts after one of them (jump), or one that grows (drift)."""

    score: float = 0.0
    """Score of the displacement, in standard deviations."""
    part: float = 0.0
    """Part of the contacts that precede the jump; NaN for a drift."""
    motion: Array = field(default_factory=lambda: np.zeros(6))
    """Displacement of the body's origin, m, and turn about it, rad (6,): small ones."""
    size: float = 0.0
    """Displacement of the contacts by it, m rms."""

    @property
    def shown(self) -> Array:
        """The motion (6,) where its score is above MIN_JUMP, else zero; of a drift its rms over the
        course, as it is one of the first contacts' frame, or of the last ones'."""
        size = 3**-0.5 if np.isnan(self.part) else 1.0
        return size * self.motion if self.score > MIN_JUMP else np.zeros(6)

    def or_displacement(self, other: Array) -> Array:
        """The motion (6,) that is shown, or a displacement (3,), m, if that is larger."""
        larger = self.shown.any() and self.size > np.linalg.norm(other)
        return self.shown if larger else np.append(other, np.zeros(3))

    @property
    def departure(self) -> dict[str, float]:
        """The score by the name of the jump, which says where it is."""
        if np.isnan(self.part):
            words = (
                f"a drift of the contacts by {1e3 * self.size:.2g} mm, as of a skin or clamp that "
                "creeps"
            )
        else:
            words = f"{JUMP} at {self.part:.0%} of the recording, as of a body mounted anew"
        return {words: self.score}

    def course(self, contact: np.ndarray, count: int) -> Array:
        """Part (k,) of the motion that each of `contact` (k,), of `count` contacts, has."""
        if np.isnan(self.part):
            return np.asarray(contact / count)
        return np.asarray(contact >= round(self.part * count), dtype=float)


def largest_jump(fitted: FittedReadings, drift: bool = True) -> Jump:
    """The most significant motion of all contacts from one of PLACES on, or between the best one
    and its neighbours; or a drift of them, if that is looked for."""
    m = len(fitted.data.points)
    places = np.unique(np.linspace(0, m, PLACES + 2).astype(int)[1:-1])
    # from the first contact on all move: that is no jump
    found = _jumps(fitted, np.append(places[places > 0] / m, [np.nan] * drift))
    first = max(found, key=lambda jump: jump.score, default=Jump())
    if first.score > MIN_JUMP / 2 and not np.isnan(first.part):
        between = np.array([-0.5, -0.25, 0.25, 0.5]) / (PLACES + 1)
        found += _jumps(fitted, np.round((first.part + between) * m) / m)
    best = Jump()
    for jump in sorted(found, key=lambda jump: -jump.score):
        if jump.score <= best.score:
            break
        if jump.score > MIN_JUMP:  # else none is shown, whatever its factor
            factor = min(_shared_deviation(fitted, jump), _usual_score(jump, found))
            jump = replace(jump, score=jump.score / factor)
        best = max(best, jump, key=lambda jump: jump.score)
    return best


def _jumps(fitted: FittedReadings, parts: Array) -> list[Jump]:
    """The jumps after `parts` of the contacts, NaN for a drift, that the readings determine."""
    points, found = fitted.data.points, list[Jump]()
    middle = points.mean(axis=0)
    arm = points - middle
    length = float(np.sqrt(np.mean(np.sum(arm**2, axis=1)))) or 1.0
    unit = np.broadcast_to(np.eye(3), (len(points), 3, 3))
    moved = fitted.moved(np.concatenate([unit, -se3.hat(arm) / length], axis=2))
    for jump, slope, information in _displaced(fitted, moved, [Jump(part=float(x)) for x in parts]):
        value, vectors = np.linalg.eigh(information)
        seen = value > MIN_SHOWN * max(float(value[-1]), 1e-300)
        if not seen.any():
            continue
        along, value, vectors = (vectors.T @ slope)[seen], value[seen], vectors[:, seen]
        score = normal_score(float(np.sum(along**2 / value)), len(value))
        shift, turn = np.split(vectors @ (along / value) / np.repeat([1.0, length], 3), 2)
        motion = np.append(shift - np.cross(turn, middle), turn)
        size = float(np.sqrt(np.mean(np.sum(displacements(motion, points) ** 2, axis=1))))
        found.append(replace(jump, score=score, motion=motion, size=size))
    return found


def displacements(motion: Array, points: Array) -> Array:
    """Displacements (n, 3), m, of points (n, 3), m, by a small motion (6,)."""
    return np.asarray(motion[:3] + np.cross(motion[3:], points))


def _usual_score(jump: Jump, found: list[Jump]) -> float:
    """Root of the mean squared score of jumps at other places, at least 1: errors that neighbouring
    contacts share raise them all; infinite for a drift, which has its displacement everywhere, and
    where they are few.

    Few groups of contacts see a jump, those next to it: they hardly tell its deviation.
    """
    scores = np.array([x.score for x in found if abs(x.part - jump.part) > APART])
    return max(1.0, float(np.mean(scores**2)) ** 0.5) if len(scores) >= MIN_PLACES else np.inf


def _shared_deviation(fitted: FittedReadings, jump: Jump) -> float:
    """Factor, at least 1, of the standard deviation of a jump by errors that neighbouring contacts
    share, in time or in place: its variance from sums over groups of contacts of the terms of its
    derivative, without the jump, over that of independent errors.

    Source: White, "Maximum likelihood estimation of misspecified models", Econometrica 50 (1982),
    with groups as in Liang and Zeger, Biometrika 73 (1986).
    """
    contact, m = fitted.readings.contact, len(fitted.data.points)
    moved = fitted.moved(displacements(jump.motion, fitted.data.points)[:, :, None])
    column = jump.course(contact, m)[:, None] * moved
    left, marginal = (part[:, 0] for part in fitted.unexplained(column))
    terms = -marginal * (fitted.rate + fitted.curvature * left)
    cell = np.floor(fitted.data.points / (GROUP * float(np.median(fitted.data.reach()))))
    in_place = np.unique(cell, axis=0, return_inverse=True)[1].ravel()
    in_time = np.arange(m) * PERIODS // m
    groups = (np.bincount(group[contact], terms) for group in (in_time, in_place))
    square = max(float(np.sum(sums**2)) for sums in groups)
    independent = float(fitted.curvature @ (marginal * left))
    return max(1.0, (square / max(independent, 1e-300)) ** 0.5)


def _displaced(
    fitted: FittedReadings, moved: Array, jumps: list[Jump]
) -> Iterator[tuple[Jump, Array, Array]]:
    """Each jump, with derivative (q,) and information (q, q) of motions in its course; moved
    (k, q): derivatives of the readings in motions of their contacts."""
    contact, m = fitted.readings.contact, len(fitted.data.points)
    for begin in range(0, len(jumps), TOGETHER):
        few = jumps[begin : begin + TOGETHER]
        course = np.stack([jump.course(contact, m) for jump in few], axis=1)
        columns = (course[:, :, None] * moved[:, None]).reshape(len(course), -1)
        slope, information = fitted.shared(columns)
        for k, jump in enumerate(few):
            at = slice(k * moved.shape[1], (k + 1) * moved.shape[1])
            yield jump, slope[at], information[at, at]


def with_outlying(estimator: JointEstimator) -> FittedReadings:
    """The readings of an estimate with those that were left out as outlying, each cut at CUTOFF,
    without what the taxels would follow of these: few taxels that are touched on both sides of a
    jump fit one, and lose the readings of the other. Residuals that are larger than the noise, as
    of contacts whose errors are not estimated, count for less."""
    readings = estimator.likelihood.readings
    fitted = fitted_readings(estimator, readings.weight)
    r = (fitted.mu - readings.level / estimator.data.sigma) * np.sqrt(readings.precision)
    observed = readings.kind == OBSERVED
    weight = np.minimum(1.0, CUTOFF / np.maximum(np.abs(r), 1e-300))
    cut = fitted_readings(estimator, np.where(observed, weight, readings.weight))
    added = (cut.rate - fitted.rate) / np.maximum(cut.curvature, 1e-300)
    rate = fitted.rate + cut.curvature * cut.unexplained(added[:, None])[0][:, 0]
    square = max(1.0, robust_sigma(r[observed]) ** 2) if observed.any() else 1.0
    return replace(cut, rate=rate / square, curvature=cut.curvature / square)


def jump_by_outliers(estimator: JointEstimator, drift: bool = True) -> Jump:
    """The motion of all contacts from one on that outlying readings show: by themselves, or with
    the others; drift: as of `largest_jump`.

    Where both show one, it is the larger: to first order, readings that are cut tell too little of
    a motion by more than their patches."""
    found = _explained_outliers(estimator), largest_jump(with_outlying(estimator), drift)
    best = max(found, key=lambda jump: jump.score)
    shown = (jump for jump in found if jump.score > MIN_JUMP)
    return replace(max(shown, key=lambda jump: jump.size, default=best), score=best.score)


def _explained_outliers(estimator: JointEstimator) -> Jump:
    """The displacement of all contacts from one on that explains outlying readings.

    Taxels that are touched on both sides of a jump fit the contacts of one side, and those of the
    other are left out; other taxels fit. The score is the root of the decrease of the squared
    residuals there, each cut at CUTOFF, but for the taxel that gains most: a change of one taxel is
    no jump, nor is what leaves most of them. The taxels are displaced in place of their contacts.
    """
    found, m = [Jump()], len(estimator.data.points)
    for place, rows in _outlying_sides(estimator.likelihood.readings, m):
        late = estimator.likelihood.readings.contact[rows] >= place
        residuals = DisplacedResiduals(estimator, rows, np.where(late, -1.0, 1.0))
        displacement = residuals.least()
        before, after = (
            np.minimum(residuals.at(x)[0] ** 2, CUTOFF**2) for x in (np.zeros(3), displacement)
        )
        gain = np.bincount(residuals.taxel, before - after)
        square = float(gain.sum() - gain.max())
        if square > 0 and gain.sum() > MIN_EXPLAINED * before.sum():
            motion, size = np.append(displacement, np.zeros(3)), np.linalg.norm(displacement)
            found.append(Jump(square**0.5, place / m, motion, float(size)))
    best = max(found, key=lambda jump: jump.score)
    alike = [jump.part for jump in found if jump.score == best.score]  # no reading tells which
    return replace(best, part=float(np.median(alike)))


def _outlying_sides(readings: Readings, m: int) -> list[tuple[int, np.ndarray]]:
    """Of m contacts those at which a jump divides outlying readings from others, and the rows of
    all readings on the outlying sides of taxels with such a side, of MIN_TAXELS or more."""
    observed = readings.kind == OBSERVED
    out, count, found = observed & outliers(readings), len(readings.starts) - 1, []
    if not out.any():
        return []
    for place in np.unique(np.linspace(1, m - 1, MAX_PLACES).astype(int)):
        late = readings.contact >= place
        read, lost = (
            np.array([np.bincount(readings.taxel[x & at], minlength=count) for at in (~late, late)])
            for x in (observed, out)
        )
        both, few, many = (read > 0).all(axis=0), lost.min(axis=0), lost.max(axis=0)
        chosen = both & (many >= MIN_OUTLYING) & (many > MIN_RATIO * few)
        mine = chosen[readings.taxel] & (late == (lost[1] > lost[0])[readings.taxel])
        if chosen.sum() >= MIN_TAXELS:
            divided = float(np.sum(np.where(both, many - 2 * few, -many)))
            found.append((divided, int(place), np.flatnonzero(observed & mine)))
    most = max((divided for divided, *_ in found), default=0.0)
    return [(place, rows) for divided, place, rows in found if divided >= NEAR_BEST * most > 0]


class DisplacedResiduals:
    """Residuals of readings whose taxels are displaced, each in one of two opposite directions."""

    def __init__(self, estimator: JointEstimator, rows: np.ndarray, sign: Array) -> None:
        """rows (q,): of the readings; sign (q,): of their taxels' displacements."""
        problem, state, readings = estimator.problem, estimator.state, estimator.likelihood.readings
        self.taxel, self.contact = readings.taxel[rows], readings.contact[rows]
        self.points = problem.points(state)[self.taxel]
        self.nuisance = problem.nuisance(state.z)[self.taxel]
        self.contacts, self.likelihood = problem.contacts.at(state.s), estimator.likelihood
        self.level, self.sign = readings.level[rows] / estimator.data.sigma, sign
        self.root = np.sqrt(readings.precision[rows])

    def at(self, displacement: Array) -> tuple[Array, Array]:
        """Residuals (q,), in standard deviations, and their derivatives (q, 3)."""
        mu, jacobian = self.likelihood.predict(
            self.contact, self.points + self.sign[:, None] * displacement, self.nuisance,
            self.contacts, self.likelihood.groups(self.taxel),
        )  # fmt: skip
        return self.root * (mu - self.level), (self.root * self.sign * jacobian[:3]).T

    def least(self, start: Array | None = None) -> Array:
        """The displacement (3,), m, with the least sum of Huber's costs, by Gauss-Newton steps with
        Levenberg's damping from `start` (3,), m, by default zero; along directions that readings
        hardly show it stays that of `start`."""
        x, damping = np.zeros(3) if start is None else start, DAMPING
        residuals, jacobian = self.at(x)
        value, vectors = np.linalg.eigh(jacobian.T @ jacobian)
        basis = vectors[:, value > MIN_SHOWN * value[-1]]
        for _ in range(MAX_STEPS):
            slopes = jacobian @ basis
            weight = np.minimum(1.0, CUTOFF / np.maximum(np.abs(residuals), 1e-300))
            matrix = slopes.T @ (weight[:, None] * slopes)
            matrix += (damping * np.trace(matrix) + 1e-300) * np.eye(len(matrix))
            step = -basis @ np.linalg.solve(matrix, slopes.T @ (weight * residuals))
            step *= min(1.0, MAX_STEP / max(float(np.linalg.norm(step)), 1e-300))
            there = self.at(x + step)
            before, after = (huber_cost(r, CUTOFF) for r in (residuals, there[0]))
            damping *= 1 / 3 if after < before else 4.0
            if after < before:
                x, (residuals, jacobian) = x + step, there
                if before - after < TOLERANCE * before:
                    break
        return x
