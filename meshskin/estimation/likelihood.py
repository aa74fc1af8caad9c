"""The likelihood of all readings as a CasADi NLP: built once, solved for any charts.

Each reading's cost, gradient and Hessian come from the compiled pressure factor, mapped over the
readings; unknowns are gathered with `.nz`, derivatives scattered by constant sparse products, so
that CasADi differentiates nothing. The charts are parameters: anchoring anew needs no rebuild.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ..errors import CalibrationError
from ..se3 import Array
from .chart import Charts
from .measurements import SPARE, Measurements, near_pairs, pair_numbers
from .pressure import LOWER, PARAMETERS, kernel, parameters

CLEAR = 5.0
"""Pressure, relative to the noise, above which a reading out of reach is kept: it is a misfit."""
PROXIMITY = 0.1
"""Scale, m, of a quadratic cost of leaving the chart's origin. It keeps a taxel that no reading
holds from a singular system, and vanishes as the charts are anchored anew."""
DECREMENT = 1e-6
"""Largest Newton decrement, in units of the cost, at which a solution is believed."""
# The gradient is in units of the noise: 1e-3 is a step of some 1e-11 m, and below it the cost, of
# the order of the number of readings, no longer shows a decrease.
IPOPT: dict[str, object] = {
    "tol": 1e-3,
    "max_iter": 60,
    "nlp_scaling_method": "none",
    "mumps_pivtol": 0.0,
    "mumps_permuting_scaling": 0,
    "mumps_scaling": 0,
    "min_refinement_steps": 0,
    "max_refinement_steps": 0,
    "print_level": 0,
    "sb": "yes",
}


@dataclass(frozen=True)
class Solution:
    """What one solve returned, after the check of its Newton decrement."""

    coordinates: Array
    """(n, 2) in the charts, m."""
    log_modulus: float
    """ln(E* / nominal E*)."""
    path: tuple[Array, ...]
    """Coordinates (n, 2), m, after each iteration, the start first."""


@dataclass(frozen=True)
class Normal:
    """The normal equations at a point: blocks of the taxels, and the shared unknown e."""

    position: Array
    """(n, 2, 2), 1/m^2."""
    coupling: Array
    """(n, 2), 1/m."""
    modulus: float
    """Information on e, the prior's included."""
    gradient: Array
    """Of the cost (n, 2), 1/m."""
    gradient_e: float
    """Of the cost by e."""
    cost2: Array
    """Sum of squared residuals of each taxel's readings (n,)."""
    counts: np.ndarray
    """Readings of each taxel (n,)."""

    @property
    def chi2(self) -> Array:
        """Squared residuals per degree of freedom (n,); NaN with none left."""
        freedom = self.counts - 2
        return self.cost2 / np.where(freedom > 0, freedom, np.nan)

    @property
    def freedom(self) -> int:
        """Readings less unknowns."""
        return int(self.counts.sum()) - 2 * len(self.counts) - 1

    def covariance(self) -> tuple[Array, float]:
        """Covariances (n, 2, 2), m^2, and variance of e, by the Schur complement of e."""
        inverse = np.linalg.inv(self.position)
        lever = np.einsum("nij,nj->ni", inverse, self.coupling)
        variance = 1.0 / (self.modulus - np.einsum("ni,ni->", lever, self.coupling))
        return inverse + variance * lever[:, :, None] * lever[:, None, :], float(variance)

    def decrement(self) -> float:
        """Newton decrement g^T H^-1 g / 2: the cost still to be gained."""
        solved = np.linalg.solve(self.position, self.gradient[:, :, None])[:, :, 0]
        _, variance = self.covariance()
        rest = self.gradient_e - np.einsum("ni,ni->", solved, self.coupling)
        total = np.einsum("ni,ni->", solved, self.gradient) + variance * rest**2
        return float(total) / 2


class Likelihood:
    """The NLP over the taxels `live` (rows of data.ids) near the points `about` (n, 3) and ln E*.

    With known noise, silent readings in reach are censored; readings out of reach that are no more
    than noise say nothing and are left out. What is in reach is judged at `about` and `e`.
    """

    def __init__(
        self, data: Measurements, live: np.ndarray, about: Array, e: float, modulus_prior: float
    ) -> None:
        self.data, self.about, self.e = data, about, e
        self.length = float(np.median(data.radii))
        self.prior = modulus_prior**-2
        place = np.full(len(data.ids), -1)
        place[live] = np.arange(len(live))
        mine = place[data.taxel] >= 0
        self.silent = _none()
        if data.noise:
            near = near_pairs(data, about, float(np.exp(-e / 3)))
            reached = pair_numbers(data, near[0], live[near[1]])
            heard = pair_numbers(data, data.contact, data.taxel)
            quiet = ~np.isin(reached, heard)
            self.silent = near[0][quiet], near[1][quiet]
            mine &= np.isin(heard, reached) | (data.pressure > CLEAR * data.noise)
        self.active = data.contact[mine], place[data.taxel[mine]]
        self.pressure = data.pressure[mine]
        self._build(len(live))

    def covers(self, charts: Charts, e: float) -> bool:
        """Whether what was judged to be in reach still is, with SPARE to spare."""
        moved = float(np.linalg.norm(charts.points - self.about, axis=1).max())
        grown = float(self.data.radii.max()) * abs(np.exp(-e / 3) - np.exp(-self.e / 3))
        return moved + grown < SPARE / 2

    def _build(self, n: int) -> None:
        x = ca.MX.sym("x", 2 * n + 1)
        kinds = [("active", self.active), ("silent", self.silent)]
        p = ca.MX.sym("p", PARAMETERS * sum(len(taxel) for _, (_, taxel) in kinds))
        weights = np.full(2 * n + 1, (self.length / PROXIMITY) ** 2)
        weights[-1] = self.prior
        gradient = ca.DM(weights) * x
        value = ca.dot(x, gradient) / 2
        sparsity, place = _pattern(n)
        entries = ca.MX(ca.project(ca.diag(ca.DM(weights)), sparsity).nz[:])
        cost, begin = value, 0
        for kind, (_, taxel) in kinds:
            k = len(taxel)
            if not k:
                continue
            own = np.stack([2 * taxel, 2 * taxel + 1, np.full(k, 2 * n)], axis=1)
            local = ca.reshape(x.nz[own.ravel().tolist()], 3, k)
            q = ca.reshape(p[begin : begin + PARAMETERS * k], PARAMETERS, k)
            begin += PARAMETERS * k
            one = kernel(kind)
            value += ca.sum2(one.value.map(k)(local, q))
            costs, slopes = one.gradient.map(k)(local, q)
            cost += ca.sum2(costs)
            gradient += _scatter(own.ravel(), 2 * n + 1) @ ca.vec(slopes)
            entries += _scatter(place[taxel].ravel(), sparsity.nnz()) @ ca.vec(
                one.hessian.map(k)(local, q)
            )
        factor, none = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", 0)
        hessian = factor * ca.MX(sparsity, entries)
        self._nlp = {"x": x, "p": p, "f": value}
        self._options: dict[str, Any] = {
            "grad_f": ca.Function("gradient", [x, p], [cost, gradient]),
            "hess_lag": ca.Function("hessian", [x, p, factor, none], [hessian.T]),
            "no_nlp_grad": True,
            "calc_f": False,
            "calc_g": False,
            "calc_lam_x": False,
            "calc_lam_p": False,
            "print_time": False,
            "ipopt": IPOPT,
        }
        self._path = _Path(2 * n + 1, p.shape[0])
        self._solver = ca.nlpsol(
            "joint", "ipopt", self._nlp, {**self._options, "iteration_callback": self._path}
        )

    def _parameters(self, charts: Charts) -> tuple[Array, Array]:
        data, length = self.data, self.length
        return (
            parameters(data, charts, *self.active, self.pressure, length),
            parameters(data, charts, *self.silent, data.threshold, length),
        )

    def solve(self, charts: Charts, e: float) -> Solution:
        """Minimise from the charts' origins. Raises CalibrationError without convergence."""
        n = len(charts.points)
        p = np.concatenate([part.ravel(order="F") for part in self._parameters(charts)])
        self._path.points.clear()
        found = self._solver(x0=np.append(np.zeros(2 * n), e), p=p)["x"].full().ravel()
        y, e = self.length * found[:-1].reshape(n, 2), float(found[-1])
        left = self.normal(charts, e, y).decrement()
        if not left < max(DECREMENT, 1e-9 * len(self.pressure)):
            raise CalibrationError(
                "the joint estimate did not converge",
                value=f"Newton decrement {left:.3g}, {self._solver.stats()['return_status']}",
                limit=DECREMENT,
                remedy="check the contact model, the noise and the units of force and pressure",
            )
        path = (self.length * q[:-1].reshape(n, 2) for q in self._path.points)
        return Solution(y, e, tuple(path))

    def normal(self, charts: Charts, e: float, y: Array | None = None) -> Normal:
        """The normal equations at coordinates `y` (n, 2), m, by default the charts' origins."""
        n = len(charts.points)
        y = np.zeros((n, 2)) if y is None else y
        h, g = np.zeros((n, 3, 3)), np.zeros((n, 3))
        cost2 = np.zeros(n)
        kinds = (("active", self.active), ("silent", self.silent))
        for (kind, (_, taxel)), p in zip(kinds, self._parameters(charts), strict=True):
            k = len(taxel)
            if not k:
                continue
            local = np.vstack([y[taxel].T / self.length, np.full(k, e)])
            one = kernel(kind)
            residual, jacobian, curvature = (v.full() for v in one.residual.map(k)(local, p))
            slope = one.gradient.map(k)(local, p)[1].full()
            for r in range(3):
                g[:, r] += np.bincount(taxel, slope[r], n)
                for c in range(3):
                    h[:, r, c] += np.bincount(taxel, curvature[0] * jacobian[r] * jacobian[c], n)
            if kind == "active":
                cost2 += np.bincount(taxel, residual[0] ** 2, n)
        unit = self.length
        return Normal(
            position=h[:, :2, :2] / unit**2 + np.eye(2) / PROXIMITY**2,
            coupling=h[:, :2, 2] / unit,
            modulus=float(h[:, 2, 2].sum()) + self.prior,
            gradient=g[:, :2] / unit + y / PROXIMITY**2,
            gradient_e=float(g[:, 2].sum()) + self.prior * e,
            cost2=cost2,
            counts=np.bincount(self.active[1], minlength=n),
        )


class _Path(ca.Callback):
    """Keeps the unknowns of every iteration."""

    def __init__(self, unknowns: int, parameters: int) -> None:
        ca.Callback.__init__(self)
        self.unknowns, self.parameters = unknowns, parameters
        self.points: list[Array] = []
        self.construct("path", {})

    def get_n_in(self) -> int:
        return int(ca.nlpsol_n_out())

    def get_n_out(self) -> int:
        return 1

    def get_sparsity_in(self, i: int) -> Any:
        name = ca.nlpsol_out(i)
        size = {"f": 1, "x": self.unknowns, "lam_x": self.unknowns, "lam_p": self.parameters}
        return ca.Sparsity.dense(size.get(name, 0))

    def eval(self, arg: Any) -> list[int]:
        self.points.append(arg[0].full().ravel())
        return [0]


def _none() -> tuple[np.ndarray, np.ndarray]:
    return np.empty(0, dtype=int), np.empty(0, dtype=int)


def _scatter(rows: np.ndarray, height: int) -> ca.DM:
    """Constant 0/1 matrix that adds each entry of a vector to its row."""
    columns = np.arange(len(rows))
    return ca.DM(ca.Sparsity.triplet(height, len(rows), rows.tolist(), columns.tolist()), 1.0)


def _pattern(n: int) -> tuple[ca.Sparsity, np.ndarray]:
    """Sparsity of the Hessian's lower triangle; each taxel's places (n, 6) in its nonzeros."""
    own = np.stack([2 * np.arange(n), 2 * np.arange(n) + 1, np.full(n, 2 * n)], axis=1)
    rows, columns = (own[:, [pair[i] for pair in LOWER]] for i in (0, 1))
    keys, place = np.unique(columns * (2 * n + 1) + rows, return_inverse=True)
    starts = np.searchsorted(keys, (2 * n + 1) * np.arange(2 * n + 2))
    sparsity = ca.Sparsity(2 * n + 1, 2 * n + 1, starts.tolist(), (keys % (2 * n + 1)).tolist())
    return sparsity, place.reshape(n, 6)
