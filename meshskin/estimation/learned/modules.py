"""Rigid modules with a learned response: taxels that were estimated one by one, moved to their
places in the modules.

The estimate of the single taxels, with its covariances, holds what the readings say; the modules
are fitted to it by generalized least squares. A module's taxels share contacts and the response, so
that their errors correlate: the covariance of all taxels of a module counts, that between modules
does not.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc

from ...core.arrays import Array
from ...core.errors import CalibrationError
from ..data.measurements import Measurements
from ..joint.coupled_system import CoupledSystem
from ..joint.module_parametrization import (
    MODULE_SURFACE,
    MODULES,
    SURFACE_SIGMA,
    ModuleParametrization,
    align_modules,
)
from ..result import EstimatorResult, join_words
from ..uncertainty import observability

STEP = 1e-3
"""Longest move of a module in one step, m."""
SETTLED = 1e-9
"""Move, m, from which the modules have converged."""
MAX_STEPS = 50
"""Largest number of steps; 4 to 6 are usual."""
APART = 30.0
"""Squared distance of a taxel's own estimate from its place in its module, in its covariance, from
which it is left out: 3e-7 by chance."""
LEVEL = 1e-3
"""Probability by chance of the misfit from which the covariances are widened."""
ELSEWHERE = "its own readings place it {:.2g} mm from its place in the module"
WIDENED = "single taxels are {:.2g} sigma from their places in the modules: widened by that"


@dataclass(frozen=True)
class _Module:
    """What the readings say of the k taxels of a module."""

    rows: np.ndarray
    """Rows (k,) of the taxels in the parametrization."""
    points: Array
    """Their own estimates (k, 3), m."""
    tangents: Array
    """(k, 3, 2)."""
    covariance: Array
    """Covariance (2k, 2k) along the tangents, m^2."""

    def residuals(self, points: Array, slope: Array) -> tuple[Array, Array]:
        """Residuals (2k,), m, of the taxels at `points` (n, 3), and their derivatives (2k, 6)."""
        apart = np.einsum("kij,ki->kj", self.tangents, points[self.rows] - self.points)
        by_pose = np.einsum("kij,kid->kjd", self.tangents, slope[self.rows])
        return apart.ravel(), by_pose.reshape(-1, by_pose.shape[2])

    def without(self, taxel: int) -> _Module:
        """The module without one of its taxels."""
        keep = np.arange(len(self.rows)) != taxel
        both = np.repeat(keep, 2)
        return _Module(
            self.rows[keep], self.points[keep], self.tangents[keep], self.covariance[both][:, both]
        )


def moved_to_modules(
    data: Measurements, found: EstimatorResult, system: CoupledSystem, live: np.ndarray
) -> EstimatorResult:
    """The result `found`, with the taxels of each module at their places in it.

    system: the normal equations of the taxels `live`. Taxels of a module that were not determined
    follow from at least two others. Raises CalibrationError as `align_modules`.
    """
    parametrization, rows = align_modules(data, found.points, found.found, STEP)
    modules = [
        _module(found, system, live, own, rows[own])
        for own in (
            np.flatnonzero(parametrization.group == g) for g in range(parametrization.count)
        )
    ]
    parametrization, modules, inverse = _converged(data, parametrization, modules)
    scale, words = _misfit(parametrization, modules)
    faults = found.faults.copy() if found.faults is not None else np.full(len(data.ids), "", object)
    kept = np.concatenate([rows[module.rows] for module in modules])
    points = found.points.copy()
    points[rows] = parametrization.points()
    for row in np.setdiff1d(rows[found.found[rows]], kept):
        away = ELSEWHERE.format(1e3 * float(np.linalg.norm(points[row] - found.points[row])))
        faults[row] = join_words(faults[row], away)
    shape = observability.shape_operators(data.body, found.points, found.rotations)
    covariance = observability.pose_covariance(found.covariance, shape)
    covariance[rows] = scale * parametrization.covariances(inverse)
    rotations, reasons, rivals = found.rotations.copy(), found.reasons.copy(), found.rivals
    rotations[rows], reasons[rows] = parametrization.rotations(), ""
    if rivals is not None:
        rivals = rivals.copy()
        rivals[rows] = np.nan
    return replace(
        found,
        points=points,
        rotations=rotations,
        covariance=covariance[:, :2, :2],
        pose_covariances=covariance,
        reasons=reasons,
        faults=faults,
        rivals=rivals,
        factors=(*found.factors, MODULES, MODULE_SURFACE, *words),
    )


def heights_of_taxels(data: Measurements, found: EstimatorResult) -> Array | None:
    """Heights (n,), m, of the taxels of rigid modules over the surface, 0 of those that have no
    place; None where all are within the tolerance of their placement.

    The normal turns along the skin: a taxel at a height h, a from the contact on a surface of
    radius R, seems displaced by h a / R, as by contact points that err.
    """
    placed = np.isfinite(found.points).all(axis=1)
    heights = np.zeros(len(found.points))
    heights[placed] = data.body.closest(found.points[placed]).distance
    return heights if np.abs(heights).max() > SURFACE_SIGMA else None


def _module(
    found: EstimatorResult,
    system: CoupledSystem,
    live: np.ndarray,
    own: np.ndarray,
    rows: np.ndarray,
) -> _Module:
    """The determined taxels among those at `own` in the parametrization, `rows` of the result.

    The correlations are those of the normal equations, the variances those of the result, which
    misfit and second optima have widened.
    """
    own, rows = own[found.found[rows]], rows[found.found[rows]]
    place, size = np.searchsorted(live, rows), system.taxels.shape[1]
    right = np.zeros((len(live), size, 2 * len(rows)))
    right[np.repeat(place, 2), np.tile([0, 1], len(rows)), np.arange(2 * len(rows))] = 1.0
    contacts = np.zeros((len(system.contacts), 3, right.shape[2]))
    solved = system.solve(right, contacts, np.zeros((len(system.shared), right.shape[2])))[0]
    joint = solved[place, :2].reshape(2 * len(rows), -1)
    blocks = [np.linalg.cholesky(joint[k : k + 2, k : k + 2]) for k in range(0, len(joint), 2)]
    wide = np.linalg.cholesky(found.covariance[rows]) @ np.linalg.inv(blocks)
    factor = np.zeros_like(joint)
    for k, block in enumerate(wide):
        factor[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = block
    return _Module(
        own, found.points[rows], found.rotations[rows][:, :, :2], factor @ joint @ factor.T
    )


def _converged(
    data: Measurements, parametrization: ModuleParametrization, modules: list[_Module]
) -> tuple[ModuleParametrization, list[_Module], Array]:
    """The modules at their optimum, without taxels that contradict the others of their module, and
    the inverses (G, 6, 6) of their normal equations. Raises CalibrationError without an end."""
    groups, modules = np.arange(parametrization.count), list(modules)
    start, n = np.zeros((len(groups), 6)), np.arange(len(parametrization.group))
    for _ in range(MAX_STEPS):
        _, gradient, hessian = parametrization.prior(start, groups)
        points, slope = parametrization.at(start[parametrization.group], parametrization.group, n)
        for g, module in enumerate(modules):
            r, j = module.residuals(points, slope)
            weighted = np.linalg.solve(module.covariance, np.column_stack([r, j]))
            gradient[g] += j.T @ weighted[:, 0]
            hessian[g] += j.T @ weighted[:, 1:]
        inverse = np.asarray(np.linalg.inv(hessian))
        step = parametrization.limit_step(-np.einsum("gij,gj->gi", inverse, gradient))
        if np.abs(step[:, :3]).max() < SETTLED:
            left = [_consistent(m, points, slope, inverse[g]) for g, m in enumerate(modules)]
            if all(a is b for a, b in zip(left, modules, strict=True)):
                return parametrization, modules, inverse
            modules = left
            continue
        parametrization = parametrization.relinearized(data.body, step)
    raise CalibrationError(
        "the rigid modules did not converge",
        value=f"{MAX_STEPS} steps",
        remedy="leave module_slots out of the belief",
    )


def _consistent(module: _Module, points: Array, slope: Array, inverse: Array) -> _Module:
    """The module without its worst taxel, if that contradicts two others."""
    if len(module.rows) < 3:
        return module
    r, j = module.residuals(points, slope)
    spread = module.covariance - j @ inverse @ j.T
    squares = [
        float(r[k : k + 2] @ np.linalg.solve(spread[k : k + 2, k : k + 2], r[k : k + 2]))
        for k in range(0, len(r), 2)
    ]
    worst = int(np.argmax(squares))
    return module.without(worst) if squares[worst] > APART else module


def _misfit(
    parametrization: ModuleParametrization, modules: list[_Module]
) -> tuple[float, tuple[str, ...]]:
    """Factor of the covariances by the distances of single taxels from their places, and what to
    say of it: 1 and nothing where chance explains them."""
    points = parametrization.points()
    slope = np.zeros((len(points), 3, 6))
    square, freedom = 0.0, 0
    for module in modules:
        r, _ = module.residuals(points, slope)
        square += float(r @ np.linalg.solve(module.covariance, r))
        freedom += max(len(r) - 3, 0)
    if not freedom or chdtrc(freedom, square) > LEVEL:
        return 1.0, ()
    return square / freedom, (WIDENED.format((square / freedom) ** 0.5),)
