"""Quintic triangular patches: S(u, v) = sum over i + j <= 5 of c_ij u^i v^j, c_ij in R^3.

u and v are the barycentric weights of a face's second and third vertex; the first has 1 - u - v.
The same formulas serve NumPy batches and, scalar by scalar, CasADi expressions.
Source of the fundamental forms: do Carmo, "Differential Geometry of Curves and Surfaces", 3-3.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core.arrays import Array, cross

DEGREE = 5
POWERS = tuple((d - j, j) for d in range(DEGREE + 1) for j in range(d + 1))
"""(i, j) of the 21 monomials u^i v^j, by total degree"""

ORDERS = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
"""derivatives (in u, in v) of S, Su, Sv, Suu, Suv, Svv"""

MIN_CURVATURE_GAP = 1e-12
"""(1/m)^2, added under the root of the difference of the curvatures: its derivative stays finite on
a sphere, and the curvatures change by at most 1e-6 1/m"""
MIN_DETERMINANT, MIN_METRIC, MAX_STEP = 1e-60, 1e-30, 0.5
"""bounds that keep CasADi's closest point finite where it is not determined or the patch is folded:
least squared determinant of the Newton matrix (m^8), least determinant of the metric (m^4), both
far below those of a face of 1 um, and longest step in u and v, half a face"""
MIN_SINE = 1e-9
"""sine of the angle between Su and Sv up to which a face has no area"""


def _derivative_table() -> tuple[NDArray[np.intp], Array]:
    """Index and factor of each derivative of each monomial among the monomials, both (6, 21)."""
    index = {power: k for k, power in enumerate(POWERS)}
    source = np.zeros((len(ORDERS), len(POWERS)), dtype=np.intp)
    factor = np.zeros((len(ORDERS), len(POWERS)))
    for row, (a, b) in enumerate(ORDERS):
        for k, (i, j) in enumerate(POWERS):
            if i >= a and j >= b:
                source[row, k] = index[i - a, j - b]
                factor[row, k] = np.prod(range(i - a + 1, i + 1)) * np.prod(range(j - b + 1, j + 1))
    return source, factor


_SOURCE, _FACTOR = _derivative_table()


def monomials(u: ArrayLike, v: ArrayLike) -> Array:
    """The 21 monomials (..., 21) at u, v (...)."""
    u, v = np.asarray(u, dtype=float), np.asarray(v, dtype=float)
    out = np.empty((*np.broadcast_shapes(u.shape, v.shape), len(POWERS)))
    out[..., 0] = 1.0
    start = 0
    for degree in range(1, DEGREE + 1):  # the degree before times u, and v^d
        below, here = slice(start, start + degree), start + degree
        out[..., here : here + degree] = out[..., below] * u[..., None]
        out[..., here + degree] = out[..., here - 1] * v
        start = here
    return out


def slopes(u: ArrayLike, v: ArrayLike) -> tuple[Array, Array]:
    """Derivatives in u and in v (..., 21) of the monomials at u, v (...)."""
    basis = monomials(u, v)
    return basis[..., _SOURCE[1]] * _FACTOR[1], basis[..., _SOURCE[2]] * _FACTOR[2]


def evaluate(coefficients: Array, u: ArrayLike, v: ArrayLike) -> tuple[Array, ...]:
    """S, Su, Sv, Suu, Suv, Svv, each (..., 3), of patches (..., 21, 3) at u, v (...)."""
    basis = np.take(monomials(u, v), _SOURCE, axis=-1) * _FACTOR  # (..., 6, 21)
    out = basis @ coefficients
    return tuple(out[..., k, :] for k in range(len(ORDERS)))


def shape(
    first: tuple[Array, Array], second: tuple[Array, Array, Array]
) -> tuple[Array, Array, Array]:
    """Outward normals (n, 3), principal curvatures (n, 2) and the first's direction (n, 3).

    `first` is (Su, Sv), `second` (Suu, Suv, Svv), each (n, 3); curvature is positive where the
    surface bends away from the normal (convex), larger first. Where Su and Sv are parallel (a face
    without area) all are zero.
    """
    (su, sv), (suu, suv, svv) = first, second
    normal = cross(su, sv)
    e, f, g = (np.einsum("ij,ij->i", a, b) for a, b in ((su, su), (su, sv), (sv, sv)))
    area2 = np.einsum("ij,ij->i", normal, normal)  # = E G - F^2
    thin = area2 <= MIN_SINE**2 * e * g
    area2[thin] = np.inf
    normal /= np.sqrt(area2)[:, None]
    ll, m, n = (-np.einsum("ij,ij->i", a, normal) for a in (suu, suv, svv))
    mean = (e * n - 2.0 * f * m + g * ll) / (2.0 * area2)
    gauss = (ll * n - m * m) / area2
    spread = np.sqrt(np.maximum(mean * mean - gauss, 0.0))
    # the shape operator about Su and n x Su: its first eigenvector is half an arctangent away
    e[thin] = 1.0
    turn = 2.0 * (m * e - f * ll) / (e * np.sqrt(area2))
    angle = 0.5 * np.arctan2(turn, 2.0 * (ll / e - mean))
    along = np.cos(angle)[:, None] * su + np.sin(angle)[:, None] * cross(normal, su)
    along *= (~thin / np.sqrt(e))[:, None]
    return normal, np.stack([mean + spread, mean - spread], axis=1), along


def _casadi_derivatives(coefficients: Any, u: Any, v: Any) -> list[Any]:
    """S, Su, Sv, Suu, Suv, Svv as CasADi (3, 1) expressions that share their monomials."""
    import casadi as ca

    mono: dict[tuple[int, int], Any] = {(0, 0): 1.0}
    for i, j in POWERS[1:]:
        mono[i, j] = mono[i - 1, j] * u if i else mono[i, j - 1] * v
    out = []
    for row in range(len(ORDERS)):
        terms = [k for k in range(len(POWERS)) if _FACTOR[row, k]]
        weights = [float(_FACTOR[row, k]) * mono[POWERS[_SOURCE[row, k]]] for k in terms]
        out.append(
            ca.vertcat(
                *(
                    sum(w * coefficients[k, c] for w, k in zip(weights, terms, strict=True))
                    for c in range(3)
                )
            )
        )
    return out


def casadi_foot(
    coefficients: Any, u: Any, v: Any, point: Any, iterations: int = 1
) -> tuple[Any, Any, Any, Any, Any]:
    """Closest point of one patch to `point` by Newton steps from (u, v), without branches.

    Solves (S - p) . Su = 0 = (S - p) . Sv with the exact second derivatives. Takes
    `coefficients` (21, 3), scalars `u`, `v` and `point` (3, 1), all SX (or MX, DM), in the body
    frame and m. Gives (u, v, S (3, 1), outward normal (3, 1), curvatures (2, 1), larger first).

    For tracking: after the last step S and its tangents are extrapolated to second order, with an
    error of the order of Newton's own, at half the cost of an evaluation; the curvature is that
    before the last step.
    """
    import casadi as ca

    for _ in range(iterations):
        s, su, sv, suu, suv, svv = _casadi_derivatives(coefficients, u, v)
        r = s - point
        gu, gv = ca.dot(r, su), ca.dot(r, sv)
        huu = ca.dot(su, su) + ca.dot(r, suu)
        huv = ca.dot(su, sv) + ca.dot(r, suv)
        hvv = ca.dot(sv, sv) + ca.dot(r, svv)
        det = huu * hvv - huv * huv
        scale = det / ca.fmax(det * det, MIN_DETERMINANT)
        du, dv = (huv * gv - hvv * gu) * scale, (huv * gu - huu * gv) * scale
        du, dv = (ca.fmin(ca.fmax(step, -MAX_STEP), MAX_STEP) for step in (du, dv))
        u, v = u + du, v + dv
    turn_u, turn_v = suu * du + suv * dv, suv * du + svv * dv
    s = s + (su + 0.5 * turn_u) * du + (sv + 0.5 * turn_v) * dv
    su, sv = su + turn_u, sv + turn_v
    e, f, g = ca.dot(su, su), ca.dot(su, sv), ca.dot(sv, sv)
    inverse_area2 = 1.0 / ca.fmax(e * g - f * f, MIN_METRIC)
    normal = ca.cross(su, sv) * ca.sqrt(inverse_area2)
    ll, m, n = -ca.dot(suu, normal), -ca.dot(suv, normal), -ca.dot(svv, normal)
    mean = (0.5 * (e * n + g * ll) - f * m) * inverse_area2
    gauss = (ll * n - m * m) * inverse_area2
    spread = ca.sqrt(ca.fmax(mean * mean - gauss, 0.0) + MIN_CURVATURE_GAP)
    return u, v, s, normal, ca.vertcat(mean + spread, mean - spread)
