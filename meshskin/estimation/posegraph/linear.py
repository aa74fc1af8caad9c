"""What is asked of a Hessian without factorising it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ...core.se3 import Array

Operator = Callable[[Array], Array]


def energy(multiply: Operator, diagonal: Array, right: Array, limit: int = 200) -> float:
    """b^T A^-1 b for the symmetric A with this `diagonal` and b = `right` (n,), to about a digit.

    `multiply`: x -> A x. Conjugate gradients add up b^T A^-1 b in positive terms (Hestenes and
    Stiefel, 1952); the sum is good once the last terms add nothing. Infinite where A turns out not
    to be positive definite.
    """
    inverse = 1.0 / _positive(diagonal)
    r = right.copy()
    z = inverse * r
    d, rz, total, terms = z, float(r @ z), 0.0, list[float]()
    for _ in range(limit):
        if rz == 0.0:
            break
        product = multiply(d)
        curvature = float(d @ product)
        if curvature <= 0.0:
            return np.inf
        step = rz / curvature
        terms.append(step * rz)
        total += terms[-1]
        if len(terms) >= 10 and sum(terms[-5:]) < 0.02 * total:
            break
        r = r - step * product
        z = inverse * r
        rz, before = float(r @ z), rz
        d = z + rz / before * d
    return total


def _positive(values: Array) -> Array:
    return np.where(values > 0.0, values, 1.0)
