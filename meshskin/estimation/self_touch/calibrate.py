"""Mounts, patches, taxels and joints of two skins from where they touch each other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...core.arguments import check_type
from ...core.arrays import Array
from ...core.errors import CalibrationError
from ...core.progress import Progress, Stage
from ...core.value import Value
from .side import SideState, TouchSide, contacts, positions

START_SCATTER = 10e-3
"""Standard deviation of the contacts' distance along each axis at the start, m: that of
neighbouring modules."""
ITERATIONS, USUAL_STEPS = 50, 10
"""Most Gauss-Newton steps, and what is usual: from mounts that are 30 mm off, ten converge."""
CONVERGED = 1e-5
"""Largest step, m or rad, at which the estimate has converged: 10 um."""
SETTLED = 1e-3
"""Relative change of the scatter in a step at which it has converged."""
CONTRADICTED = 3.0
"""Standard deviations of a prior from which an estimate contradicts it: 1 in 370 by chance."""
UNDETERMINED = 0.9
"""Share of a standard deviation before the data that is left after them, from which a direction
counts as not determined: it rests on the prior."""


@dataclass(frozen=True, eq=False)
class SelfTouch(Value):
    """Two skins calibrated against each other."""

    states: tuple[SideState, SideState]
    """Estimated unknowns of the two skins."""
    positions: tuple[Array, Array]
    """Positions (n, 3) of the taxels of each skin in its link's frame, m."""
    sigmas: tuple[Array, Array]
    """Standard deviations (u,) of the unknowns of each skin, in the order of `labels`: m or rad."""
    labels: tuple[list[str], list[str]]
    """What the unknowns are."""
    scatter: float
    """Estimated standard deviation of the distance of two contacts along each axis, m."""
    undetermined: tuple[str, ...]
    """Directions of mounts, patches and joints that rest on the priors, in words."""
    contradicted: tuple[str, ...]
    """Mounts, patches and joints that are farther from their nominal values than their priors
    allow, in words: something else is wrong, and has moved them."""
    factors: tuple[str, ...]
    """What the estimate is made of."""

    def __repr__(self) -> str:
        here, there = map(len, self.positions)
        words = f"{here} and {there} taxels, {1e3 * self.scatter:.3g} mm scatter"
        words += f", {len(self.undetermined)} directions undetermined"
        return f"<SelfTouch: {words}, {len(self.contradicted)} priors contradicted>"

    def distances(self, first: TouchSide, second: TouchSide) -> Array:
        """Distances (m,), m, of the two contacts of each touch, which may be others than those of
        the estimate."""
        pair = zip((first, second), self.states, strict=True)
        here, there = (contacts(side, state)[0] for side, state in pair)
        return np.asarray(np.linalg.norm(here - there, axis=1))


def self_touch(
    first: TouchSide, second: TouchSide, *, progress: Progress | None = None
) -> SelfTouch:
    """Calibrate two skins of one robot from touches of one against the other.

    In each touch the weighted means of the active taxels of both skins meet, up to a normal scatter
    whose variance is estimated (by expectation maximization); everything unknown has a normal prior
    with the sigmas of its side. Damped Gauss-Newton. progress("self-touch", done, total): called
    after each step. Raises CalibrationError for sides of different touches, with nothing unknown,
    or where the steps do not converge.
    """
    for side in (first, second):
        check_type(TouchSide, side, "a skin that touches")
    if len(first.readings) != len(second.readings):
        raise CalibrationError(
            "the skins have different numbers of touches",
            value=(len(first.readings), len(second.readings)),
        )
    prior = np.concatenate([first.prior_sigmas, second.prior_sigmas])
    free = prior > 0
    if not free.any():
        raise CalibrationError("nothing is unknown in a self-touch", remedy="give a sigma above 0")
    split, stage = len(first.prior_sigmas), Stage(progress, "self-touch", USUAL_STEPS)
    states, value, covariance, scatter = _fitted(first, second, prior, stage)
    stage.end()
    sigma = np.zeros(len(prior))
    sigma[free] = np.sqrt(np.diag(covariance))
    labels = first.labels, second.labels
    named = [
        f"{which}: {name}"
        for which, names in zip(("first", "second"), labels, strict=True)
        for name in names
    ]
    return SelfTouch(
        states=states,
        positions=(positions(first, states[0]), positions(second, states[1])),
        sigmas=(sigma[:split], sigma[split:]),
        labels=labels,
        scatter=scatter,
        undetermined=_undetermined(covariance, prior, free, named),
        contradicted=tuple(
            f"{name}: {abs(v) / p:.1f} sigmas of its prior"
            for name, v, p in zip(named, value, prior, strict=True)
            if ": taxel" not in name and p > 0 and abs(v) > CONTRADICTED * p
        ),
        factors=_factors(first, second),
    )


def _fitted(
    first: TouchSide, second: TouchSide, prior: Array, stage: Stage
) -> tuple[tuple[SideState, SideState], Array, Array, float]:
    """The states at which the touches meet best, the unknowns (q,) there with deviations `prior`
    (q,) before, the covariance of those with one above zero, and the scatter, m."""
    split, free = len(first.prior_sigmas), prior > 0
    states = SideState.nominal(first), SideState.nominal(second)
    value, scatter = np.zeros(len(prior)), START_SCATTER
    residual, slope = _gap(first, second, states)
    weight, damping = prior[free] ** -2.0, 0.0
    for _ in range(ITERATIONS):
        matrix, gradient = _normal_equations(residual, slope[:, free], scatter)
        matrix, gradient = matrix + np.diag(weight), gradient + weight * value[free]
        cost = _cost(residual, value[free], weight, scatter)
        while True:
            step = np.zeros(len(prior))
            step[free] = -np.linalg.solve(matrix + np.diag(damping * np.diag(matrix)), gradient)
            trial = states[0].moved(step[:split]), states[1].moved(step[split:])
            new, new_slope = _gap(first, second, trial)
            if _cost(new, value[free] + step[free], weight, scatter) <= cost * (1 + 1e-12):
                break
            damping = max(10.0 * damping, 1e-4)
            if damping > 1e6:
                raise _not_converged(scatter)
        states, value, residual, slope = trial, value + step, new, new_slope
        damping /= 10.0
        # the touches' information without the prior, in the covariance after it
        explained = len(matrix) - float(np.sum(weight * np.diag(np.linalg.inv(matrix))))
        left, before = max(len(residual) - explained, 1.0), scatter
        scatter = float(np.sqrt(max(np.sum(residual**2) / left, 1e-12)))
        stage.step()
        if np.abs(step).max() < CONVERGED and abs(scatter - before) < SETTLED * scatter:
            break
    else:
        raise _not_converged(scatter)
    matrix = _normal_equations(residual, slope[:, free], scatter)[0] + np.diag(weight)
    return states, value, np.linalg.inv(matrix).astype(float), scatter


def _not_converged(scatter: float) -> CalibrationError:
    return CalibrationError(
        "a self-touch does not converge",
        value=f"distance {1e3 * np.sqrt(3) * scatter:.3g} mm",
        remedy="start from nominal positions nearer to the true ones",
    )


def _gap(
    first: TouchSide, second: TouchSide, states: tuple[SideState, SideState]
) -> tuple[Array, Array]:
    """Differences (3 m,) of the contacts, m, and their derivative (3 m, u)."""
    here, by_first = contacts(first, states[0])
    there, by_second = contacts(second, states[1])
    slope = np.concatenate([by_first, -by_second], axis=2)
    return (here - there).ravel(), slope.reshape(here.size, -1)


def _normal_equations(residual: Array, slope: Array, scatter: float) -> tuple[Array, Array]:
    return slope.T @ slope / scatter**2, slope.T @ residual / scatter**2


def _cost(residual: Array, value: Array, weight: Array, scatter: float) -> float:
    return 0.5 * float(np.sum(residual**2) / scatter**2 + np.sum(weight * value**2))


def _undetermined(
    covariance: Array, prior: Array, free: np.ndarray, names: list[str]
) -> tuple[str, ...]:
    """The combinations of mounts, patches and joints that the data narrow by less than a tenth."""
    rows = np.array([": taxel" not in names[k] for k in np.flatnonzero(free)])
    if not rows.any():
        return ()
    scale = prior[free][rows]
    left, vectors = np.linalg.eigh(covariance[np.ix_(rows, rows)] / np.outer(scale, scale))
    known = np.flatnonzero(free)[rows]
    found = []
    for share, vector in zip(left, vectors.T, strict=True):
        if share > UNDETERMINED**2:
            main = np.argsort(-np.abs(vector))[:3]
            parts = {names[known[k]]: f"{vector[k]:+.1f} " for k in main if abs(vector[k]) > 0.2}
            alone = len(parts) == 1
            found.append(", ".join(name if alone else x + name for name, x in parts.items()))
    return tuple(found)


def _factors(first: TouchSide, second: TouchSide) -> tuple[str, ...]:
    """The priors in words."""
    said = ["contacts of both skins meet"]
    for name, side in (("first", first), ("second", second)):
        for what, value, unit in (
            ("mount", side.mount_sigma, "mm"),
            ("turn of the mount", side.mount_turn_sigma, "deg"),
            ("patches", side.patch_sigma, "mm"),
            ("turn of the patches", side.patch_turn_sigma, "deg"),
            ("taxels", side.taxel_sigma, "mm"),
            ("joint angles", side.joint_sigma, "deg"),
        ):
            shown = 1e3 * value if unit == "mm" else np.rad2deg(value)
            said += [f"{name} skin, {what}: {shown:.3g} {unit}"] if value else []
    return tuple(said)
