"""The pressure factor under patches that are no Hertzian circles.

As pressure.py, with the disc mean M of the profile (1 - x^2/a^2 - y^2/b^2)^m, x and y being the
taxel's offset from the contact along the patch's axes t and n x t (physics/contact/ellipse.py).
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from ...contact.ellipse import ellipse_gradient
from ...core.codegen import compile_function
from ...core.se3 import Array
from .batch import BATCH, evaluate

if TYPE_CHECKING:
    from .contacts import Contacts


@functools.cache
def hertzian() -> ca.Function:
    """(d (3), n (3), t (3), a, b, s) by columns, m = 1/2 -> M, its gradient in d (3), its
    derivatives in ln a and ln b.
    """
    x = ca.SX.sym("x", 12)
    mean, by_point, by_a, by_b, _ = _mean(x, 0.5)
    return _mapped("pressure_elliptic", x, mean, by_point, by_a, by_b)


@functools.cache
def free() -> ca.Function:
    """(d (3), n (3), t (3), a, b, s, m) by columns -> M, its gradient in d (3), its derivatives in
    ln a, ln b and m.
    """
    x = ca.SX.sym("x", 13)
    return _mapped("pressure_profile", x, *_mean(x, x[12]))


def _mean(x: ca.SX, exponent: ca.SX | float) -> tuple[ca.SX, ...]:
    """M and its derivatives in d (3), ln a, ln b and the exponent, of the inputs `x`."""
    along, beside = x[6:9], ca.cross(x[3:6], x[6:9])
    mean, by_x, by_y, *by_shape = ellipse_gradient(
        ca.dot(x[:3], along), ca.dot(x[:3], beside), x[9], x[10], x[11], exponent
    )
    return mean, by_x * along + by_y * beside, *by_shape


def _mapped(name: str, x: ca.SX, *outputs: ca.SX) -> ca.Function:
    return compile_function(ca.Function(name, [x], [ca.vertcat(*outputs)], {"cse": True})).map(
        BATCH
    )


def ellipse(
    offset: Array, rows: np.ndarray, contacts: Contacts, disc: float
) -> tuple[Array, Array, tuple[Array, ...]]:
    """As `pressure.circle` under elliptic Hertz patches; the shape: ln a, ln b."""
    out = evaluate(hertzian(), len(rows), *_columns(offset, rows, contacts), disc)
    return out[:, 0], out[:, 1:4], (out[:, 4], out[:, 5])


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
