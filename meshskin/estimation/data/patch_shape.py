"""The curvature of the body over a contact patch, in place of that at the contact point.

A patch presses on all of the surface under it: beside a fillet, between the flat faces of a coarse
mesh and along its long thin faces the curvature at one point is not the patch's.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...core.arrays import Array
from ...core.se3 import orthonormal_basis
from ...geometry.body import Body
from ...geometry.surface.closest_point import Closest
from ...scene.belief import Belief

MAX_HOLLOWS = 0.5
"""Largest part of the contacts in hollows tighter than the indenter, as at the creases of a mesh:
more are a body that the indenter does not fit."""
HOLLOW = 0.9
"""Curvature, relative to the indenter's, that hollows tighter than it are believed to have."""
SPOKES = 6
"""Points on each of the two rings over a patch: with its middle 13 heights for the 6 terms of a
quadric."""


def _rings() -> Array:
    """Points (1 + 2 SPOKES, 2) on rings of half the radius of a patch, and of the radius."""
    angle = 2 * np.pi * np.arange(SPOKES) / SPOKES
    turned = angle + np.pi / SPOKES
    inner = 0.5 * np.column_stack([np.cos(angle), np.sin(angle)])
    outer = np.column_stack([np.cos(turned), np.sin(turned)])
    return np.concatenate([np.zeros((1, 2)), inner, outer])


PLACES = _rings()
"""Places (k, 2) of the heights over a patch, relative to its radius."""
QUADRIC = np.linalg.pinv(
    np.column_stack(
        [
            np.ones(len(PLACES)),
            PLACES,
            PLACES[:, 0] ** 2 / 2,
            PLACES[:, 0] * PLACES[:, 1],
            PLACES[:, 1] ** 2 / 2,
        ]
    )
)
"""Matrix (6, k) from the heights at PLACES to the terms of the quadric nearest to them."""
GRAZING = 1e-6
"""Sine of the elevation over the surface within which a point in a tangent plane is outside of it:
far above rounding."""


def over_patches(belief: Belief, hit: Closest, force: Array) -> Closest:
    """The contacts `hit` (m) with the principal curvatures of the body over their patches, as large
    as those of the typical one of the forces (n,), N, and with none that the indenter does not fit.
    """
    pressed = force[force > 0]
    if not len(hit.point) or not len(pressed):
        return hit
    radius = belief.indenter.radius
    load = float(np.median(pressed)) * radius / belief.material.effective_modulus
    shaped = _curved(belief.body, hit, (0.75 * load) ** (1 / 3))  # Hertz, on a plane
    return without_hollows(shaped, radius)


def _curved(body: Body, hit: Closest, size: float) -> Closest:
    """The points `hit` with the curvatures and directions of quadrics through the surface within
    `size`, m, of them."""
    basis = orthonormal_basis(hit.normal)
    places = hit.point[:, None] + size * np.einsum("mck,pk->mpc", basis[:, :, :2], PLACES)
    places = places.reshape(-1, 3)
    above = body.surface.nearest(places, np.repeat(hit.face, len(PLACES)))
    apart, up = np.abs(above.distance), np.einsum("ij,ij->i", places - above.point, above.normal)
    # over an edge of the body the normal there is that of one of its faces
    height = np.where(up < -GRAZING * apart, -apart, apart)
    terms = height.reshape(len(basis), -1) @ QUADRIC.T / size**2
    second = np.stack([terms[:, [3, 4]], terms[:, [4, 5]]], axis=1)
    value, vector = np.linalg.eigh(second)
    along = np.einsum("mck,mk->mc", basis[:, :, :2], vector[:, :, 1])
    return replace(hit, curvature=np.ascontiguousarray(value[:, ::-1]), direction=along)


def without_hollows(hit: Closest, radius: float) -> Closest:
    """Where contacts, but not most of them, are in hollows too tight for an indenter of the radius,
    m, those with curvatures that it fits: creases of a coarse mesh have such, and no patch."""
    tight = in_hollows(hit, radius)
    return fitting(hit, radius) if tight.any() and np.mean(tight) <= MAX_HOLLOWS else hit


def in_hollows(hit: Closest, radius: float) -> np.ndarray:
    """Whether contacts (m,) are in hollows too tight for an indenter of the radius, m; `fitting`
    does not change it."""
    return np.asarray((hit.curvature <= -HOLLOW / radius).any(axis=1))


def fitting(hit: Closest, radius: float) -> Closest:
    """The contacts with curvatures that an indenter of the radius, m, fits."""
    return replace(hit, curvature=np.maximum(hit.curvature, -HOLLOW / radius))
