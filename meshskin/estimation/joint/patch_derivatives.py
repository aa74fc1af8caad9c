"""How the patches of all contacts depend on force, contact modulus and position on the body.

On a given body and layer semi-axes, exponent and p_0/E* depend on F/E* alone, for any linear
elastic model (by dimensional analysis): their derivatives in ln F at one E* give those in ln E*,
too. On a half-space lengths are proportional to (F/E*)^(1/3) and p_0 to F^(1/3) E*^(2/3); the
exponent is constant. On a layer of thickness t no power law holds: patches and derivatives come
from the contact model itself, by automatic differentiation, in units of t and E*.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from ...contact import ContactModel, Patches
from ...core.arrays import Array
from ...core.many_points import ColumnFunction
from ..data.measurements import Measurements

STEP = 5e-4
"""Step of the central differences over the surface, m: a mesh's curvatures change from face to
face, and the step averages over some of them."""
MAX_TURN = 0.3
"""Largest rotation of the principal direction over STEP, rad: beyond it the point is taken for an
umbilic, where the direction is undefined and the patch nearly a circle."""
FOOT_ITERATIONS = 6
"""Iterations that find the closest point on the paraboloid: each reduces the error by the squared
rotation of the normal."""
MAX_CHANGE = 1.0
"""Largest change of the logarithm of a patch's size or peak by a step over the surface: beyond, its
gradient, which is that of a patch at a crease of a mesh, says nothing of the patch there."""


class LoadDerivatives(NamedTuple):
    """Derivatives in ln F at constant E*: numbers, or of every contact (m, 1)."""

    shape: tuple[Any, ...]
    """Of ln a, ln b and the exponent, as far as the contact model has them."""
    peak: Any
    """Of ln p_0."""


def loaded_patches(
    data: Measurements, log_force: Array, log_modulus: float
) -> tuple[Patches, LoadDerivatives]:
    """Patches at force and E* that differ from the nominal by factors, and their derivatives.

    log_force (m,), log_modulus: logarithms of the factors.
    """
    if data.model.name == "layered":
        return _on_layer(data, log_force, log_modulus)
    length = np.exp((log_force - log_modulus) / 3)
    patch = data.patches
    found = patch._replace(
        first=patch.first * length,
        second=patch.second * length,
        peak=patch.peak * np.exp((log_force + 2 * log_modulus) / 3),
        depth=patch.depth * length**2,
    )
    return found, LoadDerivatives((1 / 3,) * (1 if data.model.name == "hertz" else 2), 1 / 3)


def _on_layer(
    data: Measurements, log_force: Array, log_modulus: float
) -> tuple[Patches, LoadDerivatives]:
    modulus, t = data.modulus * np.exp(log_modulus), data.model.thickness or 1.0
    load = np.log(data.force / (modulus * t**2)) + log_force
    kernel = _layer_kernel(data.model.poisson, data.model.thickness is None)
    radius = data.belief.indenter.radius
    out = kernel(len(load), load, data.curvature * t, radius / t)
    first, second, peak, depth, exponent = out[:5]
    by_first, by_second, by_peak, _, by_exponent = out[5:, :, None]
    found = Patches(first * t, second * t, peak * modulus, depth * t, exponent)
    return found, LoadDerivatives((by_first, by_second, by_exponent), by_peak)


@functools.cache
def _layer_kernel(poisson: float, half_space: bool) -> ColumnFunction:
    """(ln F/(E* t^2), k_1 t, k_2 t, r/t) by columns -> a/t, b/t, p_0/E*, depth/t, exponent, and
    the derivatives in ln F of the logarithms of the first four and of the exponent.

    half_space: without a thickness; t is then any unit of length.
    """
    x = ca.SX.sym("x", 4)
    patch = ContactModel("layered", poisson, None if half_space else 1.0).patches(
        force=ca.exp(x[0]), curvature=x[1:3], indenter_radius=x[3], effective_modulus=1.0
    )
    sizes = ca.vertcat(patch.first, patch.second, patch.peak, patch.depth)
    slope = ca.jacobian(ca.vertcat(ca.log(sizes), patch.exponent), x[0])
    return ColumnFunction("layer", x, ca.vertcat(sizes, patch.exponent, slope))


def stretched(patches: Patches, shape: tuple[Array, ...], aspect: float, column: int) -> Patches:
    """The patches, of the same area, with the logarithm of the semi-axes' ratio 1 + aspect times
    theirs; rewrites the derivatives (m, ks) of ln a and ln b, with those in the aspect's column."""
    half = np.log(patches.first / patches.second) / 2
    change = aspect / 2 * (shape[0] - shape[1])
    for sign, slope in zip((1.0, -1.0), shape[:2], strict=True):
        slope += sign * change
        slope[:, column] = sign * half
    stretch = np.exp(aspect * half)
    return patches._replace(first=patches.first * stretch, second=patches.second / stretch)


@dataclass(frozen=True)
class SurfaceGradients:
    """Gradients of m patches over the surface, at constant force and E*; tangent vectors."""

    first: Array
    """Of ln a (m, 3), 1/m."""
    second: Array
    """Of ln b (m, 3), 1/m."""
    exponent: Array
    """Of the profile's exponent (m, 3), 1/m."""
    peak: Array
    """Of ln p_0 (m, 3), 1/m."""
    spin: Array
    """Of the rotation of the patch's axes about the normal (m, 3), rad/m."""

    @classmethod
    def none(cls, data: Measurements) -> SurfaceGradients:
        """No gradients at the contacts of `data`."""
        return cls(*np.zeros((5, len(data.points), 3)))

    @classmethod
    def at(cls, data: Measurements) -> SurfaceGradients:
        """The gradients at the contacts of `data`, by central differences."""
        found = []
        for side in (data.directions, np.cross(data.normals, data.directions)):
            plus, minus = (
                data.at_contacts(data.body.closest(data.points + step * side))
                for step in (STEP, -STEP)
            )
            changes = [
                np.log(plus.patches.first / minus.patches.first),
                np.log(plus.patches.second / minus.patches.second),
                plus.patches.exponent - minus.patches.exponent + np.zeros(len(side)),
                np.log(plus.patches.peak / minus.patches.peak),
                _axis_rotation(data, plus) - _axis_rotation(data, minus),
            ]
            # a patch is an average over itself: at a crease of a mesh a point's curvature is not
            steepest = 2 * STEP / np.sqrt(data.patches.first * data.patches.second)
            changes = [np.clip(change, -steepest, steepest) for change in changes]
            found.append([change[:, None] * side / (2 * STEP) for change in changes])
        return cls(*(one + other for one, other in zip(*found, strict=True)))

    def patches(self, at: Patches, step: Array) -> Patches:
        """The patches after steps (m, 3), m, over the surface from `at`; no size changes by more
        than MAX_CHANGE."""
        first, second, exponent, peak = (
            np.clip(np.einsum("mi,mi->m", slope, step), -MAX_CHANGE, MAX_CHANGE)
            for slope in (self.first, self.second, self.exponent, self.peak)
        )
        return at._replace(
            first=at.first * np.exp(first),
            second=at.second * np.exp(second),
            exponent=at.exponent + exponent,
            peak=at.peak * np.exp(peak),
        )


def _axis_rotation(here: Measurements, there: Measurements) -> Array:
    """Rotation (m,), rad, of the principal directions about the normal; 0 at an umbilic."""
    second = np.cross(here.normals, here.directions)
    along, across = (
        np.einsum("mi,mi->m", axis, there.directions) for axis in (here.directions, second)
    )
    spin = across * np.where(along < 0, -1.0, 1.0)
    return np.asarray(np.where(np.abs(spin) < MAX_TURN, spin, 0.0))


def closest_on_paraboloids(
    curvature: Array, goal: Array, up: Array, height: Array
) -> tuple[Array, Array, Array]:
    """Closest points (m, 3), m, of paraboloids, normals (m, 3) there and lifts (m,), m.

    The paraboloids z = -(k_1 x^2 + k_2 y^2) / 2 have the `curvature` (m, 2), 1/m. Each point solves
    foot + height * normal = `goal` (m, 3) + lift * `up` (m, 3), m, in its contact's frame.
    """
    flat, lift = np.zeros((len(goal), 2)), np.zeros(len(goal))
    for _ in range(FOOT_ITERATIONS):
        normal = np.column_stack([curvature * flat, np.ones(len(flat))])
        normal /= np.linalg.norm(normal, axis=1)[:, None]
        off = goal + lift[:, None] * up - height[:, None] * normal
        flat = flat + (off[:, :2] - flat) / (1 + height[:, None] * curvature)
        lift = lift - (off[:, 2] + np.sum(curvature * flat**2, axis=1) / 2) / up[:, 2]
    return np.column_stack([flat, -np.sum(curvature * flat**2, axis=1) / 2]), normal, lift
