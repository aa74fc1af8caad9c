"""The information that the readings so far give on each taxel, and on what all share.

Each of n taxels has normal equations in its own unknowns u (D: two coordinates of its chart, then
ln gain and offset where declared) and the global parameters s (ks), about a point of its own
(u_0 = (0, z_0), s_0). Taxels are independent given s, so that the sums over taxels of what remains
when u is eliminated give s, and s gives every u:

    A = sum_i (H_ss - H_su H_uu^-1 H_us),   u_i = u_0 - H_uu^-1 (g_u + H_us (s - s_0))
"""

from __future__ import annotations

import numpy as np

from ...core.arrays import Array, sums_by_group
from ..chart import Charts
from ..data.global_parameters import GlobalParameters, nuisance_unit


class TaxelInformation:
    """Normal equations of n taxels, and their solution."""

    def __init__(self, n: int, parameters: GlobalParameters, unit: float) -> None:
        """unit: standard deviation, Pa, of a reading."""
        q, ks = len(parameters.nuisance_names), len(parameters.sigma)
        self.size = 2 + q
        self.weight = parameters.sigma**-2
        self.prior = _precisions(parameters, unit)
        """Prior precisions (D,) of a taxel's own unknowns, which the normal equations hold."""
        self.charts = Charts(*(np.zeros((n, *s)) for s in ((3,), (3,), (3, 2), (2, 2), ())))
        self.nuisance, self.shared = np.zeros((n, q)), np.zeros((n, ks))
        """z_0 (n, q) and s_0 (n, ks)."""
        self.gradient = np.zeros((n, self.size + ks))
        self.hessian = np.zeros((n, self.size + ks, self.size + ks))
        self.placed = np.zeros(n, dtype=bool)
        """Taxels (n,) that have a point; the others take no part."""
        self.counted = np.zeros(n, dtype=bool)
        """Placed taxels (n,) whose readings count for s: those that fit."""
        self.s = parameters.start()
        self.s_covariance = np.diag(parameters.sigma**2)
        self.step = np.zeros((n, self.size))
        """u - u_0 (n, D)."""
        self.covariance = np.full((n, self.size, self.size), np.inf)
        self._inverse = np.zeros((n, self.size, self.size))
        self._response = np.zeros((n, self.size, 1 + ks))
        self._matrix, self._right = np.zeros((n, ks, ks)), np.zeros((n, ks))
        self._bare, self._gains = np.zeros((n, ks, ks)), np.zeros((n, ks))
        names = parameters.nuisance_names
        self._gain = 2 + names.index("gain") if "gain" in names else None

    def points(self, rows: np.ndarray) -> Array:
        """Estimated points (r, 3), m, of placed taxels."""
        return self.charts[rows].at(self.step[rows, :2])

    def nuisances(self, rows: np.ndarray) -> Array:
        """Estimated ln gains and offsets (r, q)."""
        return np.asarray(self.nuisance[rows] + self.step[rows, 2:])

    def put(
        self, rows: np.ndarray, charts: Charts, nuisance: Array, gradient: Array, hessian: Array
    ) -> None:
        """Replace the normal equations of the taxels `rows` (r,) by those about new points, and
        about the present s; gradient (r, D + ks) and hessian have the priors of u, not of s."""
        for mine, new in zip(vars(self.charts).values(), vars(charts).values(), strict=True):
            mine[rows] = new
        self.nuisance[rows], self.shared[rows] = nuisance, self.s
        self.gradient[rows], self.hessian[rows] = gradient, hessian
        self.step[rows] = 0.0
        self.placed[rows] = True
        self._eliminate(rows)

    def add(self, owner: np.ndarray, jacobian: Array, rate: Array, curvature: Array) -> None:
        """Add k readings of the taxels `owner` (k,), linearized at the present estimates.

        jacobian (k, D + ks): derivatives of the readings; rate and curvature (k,): first and second
        derivative of their costs.
        """
        moved = np.concatenate([self.step[owner], self.s - self.shared[owner]], axis=1)
        rate = rate - curvature * np.einsum("ki,ki->k", jacobian, moved)
        rows, own = np.unique(owner, return_inverse=True)
        weighted = jacobian * curvature[:, None]
        self.gradient[rows] += sums_by_group(jacobian * rate[:, None], own, len(rows))
        self.hessian[rows] += sums_by_group(
            weighted[:, :, None] * jacobian[:, None, :], own, len(rows)
        )
        self._eliminate(rows)

    def rescale(self, ratio: float) -> None:
        """Take a standard deviation of the readings that is 1 / `ratio` times the one before.

        Exact for normal readings; where they are censored, until they are linearized again."""
        d, own = self.size, np.arange(self.size)
        unit = np.array([1.0 if k in (0, 1, self._gain) else ratio for k in own])  # of an offset
        self.hessian[:, own, own] -= self.prior
        self.gradient[:, 2:d] -= self.prior[2:] * self.nuisance
        self.hessian *= ratio**2
        self.gradient *= ratio**2
        self.hessian[:, :d] /= unit[:, None]
        self.hessian[:, :, :d] /= unit
        self.gradient[:, :d] /= unit
        self.prior, self.nuisance = self.prior / unit**2, self.nuisance * unit[2:]
        self.step *= unit
        self.hessian[:, own, own] += self.prior
        self.gradient[:, 2:d] += self.prior[2:] * self.nuisance
        self._eliminate(np.flatnonzero(self.placed))
        self.solve()

    def take_priors(self, parameters: GlobalParameters, unit: float) -> None:
        """Take the priors of `parameters`; unit: standard deviation, Pa, of a reading."""
        prior, own = _precisions(parameters, unit), np.arange(self.size)
        change = prior - self.prior
        self.hessian[:, own, own] += change
        self.gradient[:, 2 : self.size] += change[2:] * self.nuisance
        self.prior, self.weight = prior, parameters.sigma**-2
        self._eliminate(np.flatnonzero(self.placed))
        self.solve()

    def _eliminate(self, rows: np.ndarray) -> None:
        d, h = self.size, self.hessian[rows]
        own = h[:, :d, :d]
        inverse = np.linalg.inv(own)
        right = np.concatenate([self.gradient[rows, :d, None], h[:, :d, d:]], axis=2)
        response = inverse @ right
        rest = h[:, d:, d:] - np.swapaxes(h[:, :d, d:], 1, 2) @ response[:, :, 1:]
        slope = self.gradient[rows, d:] - np.einsum("rik,ri->rk", h[:, :d, d:], response[:, :, 0])
        self._inverse[rows], self._response[rows] = inverse, response
        self._matrix[rows] = rest
        self._right[rows] = np.einsum("rkl,rl->rk", rest, self.shared[rows]) - slope
        self._bare[rows] = rest
        if d > 2:
            bare = np.linalg.pinv(own - np.diag(self.prior), rcond=1e-12, hermitian=True)
            follows = bare @ h[:, :d, d:]
            self._bare[rows] = h[:, d:, d:] - np.swapaxes(h[:, :d, d:], 1, 2) @ follows
            if self._gain is not None:
                self._gains[rows] = -follows[:, self._gain]

    def solve(self) -> None:
        """Bring s, all steps and covariances up to date."""
        matrix = self._matrix[self.counted].sum(axis=0) + np.diag(self.weight)
        self.s_covariance = np.asarray(np.linalg.inv(matrix))
        self.s = self.s_covariance @ self._right[self.counted].sum(axis=0)
        change, follows = self.s - self.shared, self._response[:, :, 1:]
        self.step = -self._response[:, :, 0] - np.einsum("nik,nk->ni", follows, change)
        self.covariance = self._inverse + follows @ self.s_covariance @ np.swapaxes(follows, 1, 2)

    def joint_covariance(self, rows: np.ndarray) -> Array:
        """Covariances (r, D + ks, D + ks) of the taxels' own unknowns and s."""
        d, shared = self.size, self.s_covariance
        follows = -self._response[rows, :, 1:]
        out = np.empty((len(rows), d + len(shared), d + len(shared)))
        out[:, :d, :d], out[:, d:, d:] = self.covariance[rows], shared
        out[:, :d, d:] = follows @ shared
        out[:, d:, :d] = np.swapaxes(out[:, :d, d:], 1, 2)
        return out

    @property
    def of_shared(self) -> tuple[Array, Array | None]:
        """Information (ks, ks) of the readings on s without any prior, and the derivative (ks,) of
        the mean ln gain by s where gains are declared: as `ReducedProblem.information`."""
        gains = None
        if self._gain is not None and self.counted.any():
            gains = self._gains[self.counted].mean(axis=0)
        return self._bare[self.counted].sum(axis=0), gains


def _precisions(parameters: GlobalParameters, unit: float) -> Array:
    """Prior precisions (D,) of a taxel's own unknowns; unit: as `TaxelInformation`."""
    sigma = [
        s / nuisance_unit(name, unit)
        for name, s in zip(parameters.nuisance_names, parameters.nuisance_sigma, strict=True)
    ]
    return np.concatenate([np.zeros(2), np.array(sigma) ** -2.0])
