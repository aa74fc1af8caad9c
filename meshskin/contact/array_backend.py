"""Formulas that accept NumPy arrays and CasADi expressions, and Chebyshev series for both."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..core.arrays import Array


def is_casadi(*values: Any) -> bool:
    """Whether any of `values` is a CasADi matrix."""
    return any(type(value).__module__.split(".")[0] == "casadi" for value in values)


def functions(*values: Any) -> Any:
    """The module with sqrt, exp, log, fmin, fmax, atan2 for `values`: casadi or numpy."""
    if not is_casadi(*values):
        return np
    import casadi

    return casadi


def positive_part(value: Any) -> Any:
    """`value` where it is positive, else 0; NaN of arrays stays, which fmax would hide."""
    return functions(value).fmax(value, 0.0) if is_casadi(value) else np.maximum(value, 0.0)


def chebyshev_nodes(count: int) -> Array:
    """Chebyshev points (count,) of the second kind in [-1, 1], ascending, including both ends."""
    return np.asarray(-np.cos(np.pi * np.arange(count) / (count - 1)))


def chebyshev_coefficients(values: Array) -> Array:
    """Coefficients (n, ...) of the series through `values` (n, ...) at `chebyshev_nodes(n)`."""
    basis = np.polynomial.chebyshev.chebvander(chebyshev_nodes(len(values)), len(values) - 1)
    flat = np.linalg.solve(basis, values.reshape(len(values), -1))
    return np.asarray(flat.reshape(values.shape))


def chebyshev_values(coefficients: Array, x: Any) -> list[Any]:
    """Values at `x` in [-1, 1] of the k series with `coefficients` (n, k), n > 2.

    Clenshaw's recurrence: numpy's chebval does not accept CasADi expressions.
    """
    double = 2 * x
    out = []
    for column in coefficients.T.tolist():
        last, value = 0 * x + column[-1], column[-2] + column[-1] * double
        for c in column[-3:0:-1]:
            last, value = value, c + double * value - last
        out.append(column[0] + x * value - last)
    return out
