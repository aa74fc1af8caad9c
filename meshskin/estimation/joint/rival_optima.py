"""Rival optima: other positions at which the readings of a taxel fit nearly as well.

A taxel that was touched from one side only, or along a line, may have two optima: its position and
the mirror image on the other side of its contacts. A covariance describes one optimum and does not
know of the other. So a taxel whose contacts leave a wide sector of directions open, or whose
readings misfit, is started again from the mirror image and from a ring about its contacts, with the
global parameters fixed. Optima that fit better replace the estimate; those that fit nearly as well
are its rivals.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar, cast

import numpy as np

from ...contact.reading import same_sheet
from ...core.arrays import Array, means_by_group, ranges
from .joint_estimator import JointEstimator
from .likelihood import Likelihood
from .parametrization import SurfaceParametrization
from .pressure import OBSERVED, costs
from .readings import Readings, select
from .variable_projection import MAX_STEPS, ReducedProblem

T = TypeVar("T")

OPEN_SECTOR = np.radians(150.0)
"""Angle between the directions from a taxel to neighbouring contacts up to which its optimum is
unique: it lies among its contacts. All rivals found on robot links had more than 190 degrees."""
MISFIT = 3.0
"""Cost of a taxel's readings beyond that of noise, in standard deviations, above which it may be at
a wrong optimum, among its contacts or not: on a rounded edge of a robot link one was 3 mm off."""
FACING = 0.5
"""Mean cosine between the normals at a taxel and at its contacts below which all directions are
open: the taxel is on another face, whose tangent plane does not show where the contacts are."""
DIRECTIONS = 8
"""Starting points on the ring about the contacts."""
RING = 0.8
"""Radius of the ring, in reaches of a contact."""
ITERATIONS = 4
"""Number of relinearizations of the charts in the search for a rival optimum."""
MAX_LOG_ODDS = 15.0
"""Largest difference of the log-likelihoods at which an optimum is a rival: odds of 3e-7, the
probability of an error of 5 standard deviations. It is multiplied by the variance of the residuals
where that exceeds 1: the noise is not known, or the model misfits."""
MAX_VARIANCE = 25.0
"""Variance of the residuals, in units of a known noise, above which no rivals are looked for: the
model is wrong, and what is likely under it says nothing."""
MIN_DISTANCE = 0.05
"""Least distance of a rival from the estimate, in reaches of a contact."""
MIN_ON_SHEET = 0.5
"""Least part of the responding contacts that must press the sheet of skin of a rival."""
RESPONSE_SIGMAS = 5.0
"""Pressure, in standard deviations of the noise, above which a reading is a response: noise over a
low threshold comes from all directions, and would close open sectors. A recording has 1e5 silent
readings, of which noise lifts 130 above 3 standard deviations and none above 5."""
MIN_EXPECTED = 0.5
"""Part of a response that the model must expect for it to close a sector: one of 5 standard
deviations by noise, or an outlier, is of a contact out of reach, which tells nothing of the place.
"""
NUISANCE_STEPS = 2
"""Newton steps to the best gain and offset at a position: readings are linear in the offset and
nearly so in the logarithm of the gain."""
AWAY = 1e3
"""Coordinates of a place that no contact reaches, m."""
MAX_COPIES = 4096
"""Copies of taxels, at different positions, that are optimized together: limits the memory."""
MAX_MOVES = 3
"""Largest number of times that taxels are moved to better optima."""


@dataclass(frozen=True)
class RivalOptima:
    """The most likely rival of each live taxel; NaN and inf where there is none."""

    points: Array
    """(n, 3), body frame, m."""
    log_odds: Array
    """Log-likelihood (n,) of the estimate minus that of the rival."""

    @classmethod
    def none(cls, n: int) -> RivalOptima:
        """No rivals of n taxels."""
        return cls(np.full((n, 3), np.nan), np.full(n, np.inf))


def resolve_rivals(estimator: JointEstimator) -> RivalOptima:
    """Move taxels to rival optima that fit better; returns the rivals that remain.

    Where the global parameters stay, taxels are independent: the rivals of those that stay, too,
    are known.
    """
    found = find_rivals(estimator)
    for _ in range(MAX_MOVES):
        better = found.log_odds < 0.0
        if not better.any():
            break
        points = estimator.problem.points(estimator.state)
        estimator.start_at(np.where(better[:, None], found.points, points), select_anew=True)
        estimator.converge()
        among = better if estimator.frozen else np.ones_like(better)
        anew = find_rivals(estimator, among)
        found = RivalOptima(
            np.where(among[:, None], anew.points, found.points),
            np.where(among, anew.log_odds, found.log_odds),
        )
    return found


def find_rivals(estimator: JointEstimator, among: np.ndarray | None = None) -> RivalOptima:
    """The rival optima of a converged estimate, of the taxels `among` (n,) bool, by default of
    all."""
    n = len(estimator.live)
    best = RivalOptima.none(n)
    if not isinstance(estimator.problem.parametrization, SurfaceParametrization):
        return best
    points = estimator.problem.points(estimator.state)
    read, moments = estimator.likelihood.readings, estimator.state.moments
    count = np.bincount(read.taxel[read.kind == OBSERVED], minlength=n)
    variance = float(moments.square.sum()) / max(int(count.sum()), 1)
    noise = max(variance, 1.0) * (count / 2 + MISFIT * np.sqrt(count / 2))
    doubtful = (open_sectors(estimator, points) > OPEN_SECTOR) | (moments.cost > noise)
    rows = np.flatnonzero(doubtful if among is None else doubtful & among)
    if not len(rows):
        return best
    if estimator.data.noise is not None and variance > MAX_VARIANCE:
        return best
    limit = MAX_LOG_ODDS * max(variance, 1.0)
    parts = batches(rows, DIRECTIONS + 1)
    estimator.stage.expect(len(parts))
    for part in parts:
        estimator.stage.step()
        places, odds = finish(likeliest_rivals(estimator, part, points[part]))
        near = odds < limit
        best.points[part[near]], best.log_odds[part[near]] = places[near], odds[near]
    return best


def likeliest_rivals(
    estimator: JointEstimator, rows: np.ndarray, points: Array, most: int = MAX_STEPS
) -> Generator[None, None, tuple[Array, Array]]:
    """The likeliest other optimum of each of the taxels `rows` at `points` (r, 3): its place
    (r, 3), m, and the log-likelihood (r,) of the estimate minus that of the optimum, inf where
    there is none. The generator yields before every `most` Gauss-Newton steps."""
    reach = float(np.median(estimator.data.reach()))
    starts = starting_points(estimator, rows, points, reach)
    copies, here = np.tile(rows, len(starts)), np.tile(points, (len(starts), 1))
    found = yield from optimum_from(estimator, copies, np.concatenate(starts), most)
    valid = np.linalg.norm(found[0] - here, axis=1) > MIN_DISTANCE * reach
    valid &= part_on_sheet(estimator, copies, found[0]) >= MIN_ON_SHEET
    present = Placed(estimator, copies, here, estimator.state.z[copies])
    odds = log_odds_between(present, Placed(estimator, copies, *found))
    odds = np.where(valid, odds, np.inf).reshape(len(starts), -1)
    likeliest, each = odds.argmin(axis=0), np.arange(len(rows))
    return found[0].reshape(len(starts), -1, 3)[likeliest, each], odds[likeliest, each]


def finish(work: Generator[None, None, T]) -> T:
    """The result of a generator after all its parts."""
    while True:
        try:
            next(work)
        except StopIteration as end:
            return cast(T, end.value)


def batches(rows: np.ndarray, copies: int) -> list[np.ndarray]:
    """The taxels `rows` in parts of about MAX_COPIES copies at most, `copies` of each taxel."""
    return np.array_split(rows, -(-len(rows) * copies // MAX_COPIES))


def open_sectors(estimator: JointEstimator, points: Array) -> Array:
    """Largest angle (n,), rad, between the directions from taxels at `points` (n, 3) to contacts
    that they respond to, as the model expects, and that are neighbours in direction, in the tangent
    plane; 2 pi where their normals are far from the taxel's."""
    read = estimator.likelihood.readings
    size = np.sqrt(read.precision) * read.level / estimator.data.sigma
    expected = estimator.residuals() > (MIN_EXPECTED - 1) * size
    used = _responding(estimator) & expected
    taxel, contact = read.taxel[used], read.contact[used]
    frames = estimator.problem.parametrization.rotations()[taxel]
    offset = estimator.problem.contacts.data.points[contact] - points[taxel]
    x, y, _ = np.einsum("kij,ki->jk", frames, offset)
    normals = estimator.problem.contacts.data.normals[contact]
    cosine = np.einsum("ki,ki->k", frames[:, :, 2], normals)
    facing = means_by_group(cosine, taxel, len(points)) >= FACING
    angle = np.arctan2(y, x)
    order = np.lexsort((angle, taxel))
    taxel, angle = taxel[order], angle[order]
    found = np.full(len(points), 2 * np.pi)
    if not len(taxel):
        return found
    met, begin = np.unique(taxel, return_index=True)
    last = np.append(begin[1:], len(taxel)) - 1
    gap = np.diff(angle, append=0.0)
    gap[last] = angle[begin] + 2 * np.pi - angle[last]  # back to the first direction
    found[met] = np.maximum.reduceat(gap, begin)
    return np.where(facing, found, 2 * np.pi)


def responses(estimator: JointEstimator) -> tuple[np.ndarray, np.ndarray, Array]:
    """Taxel, contact and level (k,), Pa, of the observed readings that are neither outlying nor
    noise; of all that are not outlying for a taxel without any."""
    read, used = estimator.likelihood.readings, _responding(estimator)
    return read.taxel[used], read.contact[used], read.level[used]


def _responding(estimator: JointEstimator) -> np.ndarray:
    """The readings (k,) bool of `responses`."""
    read = estimator.likelihood.readings
    sound = (read.kind == OBSERVED) & (read.weight > 0.5)
    strong = sound & (read.level > RESPONSE_SIGMAS * estimator.data.sigma)
    weak = np.bincount(read.taxel[strong], minlength=len(estimator.live)) == 0
    return np.asarray(strong | (sound & weak[read.taxel]))


def part_on_sheet(estimator: JointEstimator, rows: np.ndarray, points: Array) -> Array:
    """Part (r,) of the responding contacts that press the sheet of skin at `points` (r, 3)."""
    taxel, contact, _ = responses(estimator)
    count = np.bincount(taxel, minlength=len(estimator.live))[rows]
    first = np.searchsorted(taxel, rows)
    owner, contact = np.repeat(np.arange(len(rows)), count), contact[ranges(first, count)]
    contacts, normals = estimator.problem.contacts.data, estimator.data.body.closest(points).normal
    on = same_sheet(
        points[owner] - contacts.points[contact], contacts.normals[contact], normals[owner]
    )
    return np.bincount(owner[on], minlength=len(rows)) / np.maximum(
        np.bincount(owner, minlength=len(rows)), 1
    )


def starting_points(
    estimator: JointEstimator, rows: np.ndarray, points: Array, reach: float
) -> list[Array]:
    """Starting points (r, 3): the mirror image in the line of the contacts, the ring about them."""
    contacts = estimator.problem.contacts.data.points
    frames = estimator.problem.parametrization.rotations()[rows]
    taxel, contact, level = responses(estimator)
    centre, axis = points.copy(), np.zeros_like(points)
    for k, row in enumerate(rows):
        mine = slice(*np.searchsorted(taxel, [row, row + 1]))
        if mine.start < mine.stop:
            centre[k] = level[mine] @ contacts[contact[mine]] / level[mine].sum()
            flat = (contacts[contact[mine]] - centre[k]) @ frames[k, :, :2]
            axis[k] = frames[k, :, :2] @ np.linalg.svd(flat, full_matrices=False)[2][0]
    offset = points - centre
    kept = np.einsum("ki,ki->k", offset, axis)[:, None] * axis
    kept += np.einsum("ki,ki->k", offset, frames[:, :, 2])[:, None] * frames[:, :, 2]
    angles = 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    ring = [np.cos(t) * frames[:, :, 0] + np.sin(t) * frames[:, :, 1] for t in angles]
    return [centre + 2 * kept - offset, *(centre + RING * reach * way for way in ring)]


def problem_of(
    estimator: JointEstimator, rows: np.ndarray, points: Array, readings: Readings
) -> ReducedProblem:
    """The problem of the taxels `rows` alone, linearized at `points` (r, 3). A row may be there
    several times, here and below: copies of a taxel at several points."""
    whole = estimator.problem.parametrization
    assert isinstance(whole, SurfaceParametrization)
    own = replace(whole, charts=whole.charts[rows], side=None).about(estimator.data.body, points)
    likelihood = Likelihood(estimator.data, readings)
    return ReducedProblem(likelihood, own, estimator.problem.contacts, estimator.inner_tolerance)


def readings_of(estimator: JointEstimator, rows: np.ndarray, points: Array) -> Readings:
    """The readings that inform about the taxels `rows` at `points` (r, 3)."""
    return select(
        estimator.problem.contacts.data, estimator.live[rows], points,
        estimator.data.body.closest(points).normal, estimator.selected_at[2],
        estimator.weight, estimator.silent_weight[rows],
    )  # fmt: skip


def optimum_from(
    estimator: JointEstimator, rows: np.ndarray, start: Array, most: int
) -> Generator[None, None, tuple[Array, Array]]:
    """Points (r, 3) and unknowns (r, D) of the optima reached from `start` (r, 3), with the global
    parameters fixed. The generator yields before every `most` Gauss-Newton steps."""
    points, z = start, estimator.state.z[rows].copy()
    for _ in range(ITERATIONS):
        z[:, :2] = 0.0
        problem = problem_of(estimator, rows, points, readings_of(estimator, rows, points))
        state = problem.start(estimator.state.s, z)
        for _ in range(MAX_STEPS // most):
            yield
            problem.solve_inner(state, most=most)
            if (state.decrement <= problem.inner_tolerance).all():
                break
        z = state.z.copy()
        points = estimator.data.body.closest(problem.points(state)).point
    return points, z


@dataclass(frozen=True)
class Placed:
    """Taxels `rows` (r,) at points (r, 3), m; their gains and offsets are sought from z (r, D)."""

    estimator: JointEstimator
    rows: np.ndarray
    points: Array
    z: Array

    @cached_property
    def readings(self) -> Readings:
        """The readings that inform about them there."""
        return readings_of(self.estimator, self.rows, self.points)

    @cached_property
    def best(self) -> tuple[Array, Array]:
        """The best gains and offsets (r, .) there, and the costs (r,) of the readings with them."""
        start, nuisance = self.estimator.state.s, self.z.copy()
        problem = problem_of(self.estimator, self.rows, self.points, self.readings)
        nuisance[:, :2] = 0.0
        for _ in range(NUISANCE_STEPS if problem.per_taxel else 0):
            blocks = problem.blocks(problem.start(start, nuisance))
            step = np.linalg.solve(blocks.hessian[:, 2:, 2:], blocks.gradient[:, 2:, None])
            nuisance[:, 2:] -= step[:, :, 0]
        return nuisance[:, 2:], problem.blocks(problem.start(start, nuisance)).cost


def log_odds_between(first: Placed, second: Placed) -> Array:
    """Log-likelihood (r,) of taxels at their `first` places minus that at the second, of all
    readings that inform about either; gains and offsets are the best ones there. Readings that
    inform about the other place alone are out of reach, or of a contact that presses another sheet:
    the taxel is at rest."""
    found = []
    for at, other in ((first, second), (second, first)):
        rest = _costs_at_rest(at.estimator, at.best[0], at.readings, other.readings)
        found.append(at.best[1] + rest)
    return np.asarray(found[1] - found[0])


def _costs_at_rest(
    estimator: JointEstimator, nuisance: Array, own: Readings, other: Readings
) -> Array:
    """Costs (r,) of the readings of r taxels in `other` that are not in `own`, of taxels at rest,
    with nuisance parameters (r, .)."""
    data, contacts = estimator.data, estimator.problem.contacts.at(estimator.state.s)
    keys = [read.taxel * len(data.points) + read.contact for read in (other, own)]
    read = other.without(np.isin(*keys))
    away = np.full((len(nuisance), 3), AWAY)
    mu = Likelihood(data, read).means(away, nuisance, contacts)
    cost = read.weight * read.precision * costs(mu, read.level / data.sigma, read.kind)[0]
    return np.asarray(np.bincount(read.taxel, cost, len(nuisance)), dtype=float)
