"""The pressure factor under patches that are no Hertzian circles.

As pressure.py, with the disc mean M of the profile (1 - x^2/a^2 - y^2/b^2)^m, x and y being the
taxel's offset from the contact along the patch's axes t and n x t. The mean is the sum of
physics/contact/ellipse.py, and the derivatives are exactly those of the sum, by automatic
differentiation: so cost and gradient belong together, whatever the sum's own error.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from ...compiled import compiled
from ...physics.contact.ellipse import ellipse_mean
from ...se3 import Array
from .batch import BATCH, evaluate

if TYPE_CHECKING:
    from .shared import Contacts


@functools.cache
def hertzian() -> ca.Function:
    """(d (3), n (3), t (3), a, b, s) by columns, m = 1/2 -> M, its gradient in d (3), its
    derivative in the logarithm of both semi-axes.
    """
    x = ca.SX.sym("x", 12)
    place, across = _place(x)
    mean = ellipse_mean(place[0], place[1], x[9], x[10], x[11])
    by_place, by_axes = ca.gradient(mean, place), ca.gradient(mean, x[9:11])
    return _mapped("pressure_elliptic", x, place, mean, across @ by_place, ca.dot(x[9:11], by_axes))


@functools.cache
def free() -> ca.Function:
    """(d (3), n (3), t (3), a, b, s, m) by columns -> M, its gradient in d (3), its derivatives in
    ln a, ln b and m.
    """
    x = ca.SX.sym("x", 13)
    place, across = _place(x)
    mean = ellipse_mean(place[0], place[1], x[9], x[10], x[11], x[12])
    by_place, by_axes = ca.gradient(mean, place), ca.gradient(mean, x[9:11])
    by_exponent = ca.gradient(mean, x[12])
    return _mapped(
        "pressure_profile", x, place, mean, across @ by_place, x[9:11] * by_axes, by_exponent
    )


def _place(x: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Symbols of a place in the patch's axes, and these axes (3, 2) of the inputs `x`."""
    return ca.SX.sym("place", 2), ca.horzcat(x[6:9], ca.cross(x[3:6], x[6:9]))


def _mapped(name: str, x: ca.SX, place: ca.SX, *outputs: ca.SX) -> ca.Function:
    """The compiled function of the columns `x`, with `place` where their taxel is."""
    inner = ca.Function("place", [x, place], [ca.vertcat(*outputs)], {"cse": True})
    out = inner(x, _place(x)[1].T @ x[:3])
    return compiled(ca.Function(name, [x], [out], {"cse": True})).map(BATCH)


def ellipse(
    offset: Array, rows: np.ndarray, contacts: Contacts, disc: float
) -> tuple[Array, Array, tuple[Array, ...]]:
    """As `pressure.circle` under elliptic Hertz patches; the shape: ln of both semi-axes."""
    out = evaluate(hertzian(), len(rows), *_columns(offset, rows, contacts), disc)
    return out[:, 0], out[:, 1:4], (out[:, 4],)


def profile(
    offset: Array, rows: np.ndarray, contacts: Contacts, disc: float
) -> tuple[Array, Array, tuple[Array, ...]]:
    """As `pressure.circle` under patches of any exponent; the shape: ln a, ln b, exponent."""
    out = evaluate(
        free(), len(rows), *_columns(offset, rows, contacts), disc, contacts.patches.exponent[rows]
    )
    return out[:, 0], out[:, 1:4], (out[:, 4], out[:, 5], out[:, 6])


def _columns(offset: Array, rows: np.ndarray, contacts: Contacts) -> tuple[Array, ...]:
    patch = contacts.patches
    return (
        offset, contacts.normals[rows], contacts.directions[rows],
        patch.first[rows], patch.second[rows],
    )  # fmt: skip
