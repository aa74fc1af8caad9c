"""LDL^T factors of small symmetric matrices of CasADi expressions: A = L D L^T.

One reciprocal per row and no square root: in machine code this takes half the time of `ca.chol` or
`ca.solve`, whose divisions and roots depend on each other. `ca.ldl` keeps the divisions in its
solves. Source: Golub, Van Loan, "Matrix Computations" (2013), 4.1.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca


@dataclass(frozen=True)
class Factor:
    """Factors of a symmetric positive definite matrix (n, n)."""

    lower: list[list[Any]]
    """Rows of L to the left of its unit diagonal."""
    inverse: list[Any]
    """1 / D (n,)."""

    @classmethod
    def of(cls, matrix: Any) -> Factor:
        """The factors of a symmetric matrix (n, n); only its lower triangle is read."""
        lower: list[list[Any]] = []
        inverse: list[Any] = []
        for i in range(matrix.shape[0]):
            scaled: list[Any] = []  # L_ij D_j
            for j in range(i):
                inner = sum(scaled[k] * lower[j][k] for k in range(j))
                scaled.append(matrix[i, j] - inner)
            row = [s * d for s, d in zip(scaled, inverse, strict=True)]
            inner = sum(s * x for s, x in zip(scaled, row, strict=True))
            lower.append(row)
            inverse.append(1.0 / (matrix[i, i] - inner))
        return cls(lower, inverse)

    def solve(self, right: Any) -> Any:
        """A^-1 right (n, k)."""
        return ca.horzcat(*(self._solve(right[:, k]) for k in range(right.shape[1])))

    def _solve(self, right: Any) -> Any:
        x: list[Any] = []
        for i, row in enumerate(self.lower):
            x.append(right[i] - sum(row[k] * x[k] for k in range(i)))
        x = [value * d for value, d in zip(x, self.inverse, strict=True)]
        for i in reversed(range(len(x))):
            for k in range(i):
                x[k] = x[k] - self.lower[i][k] * x[i]
        return ca.vertcat(*x)
