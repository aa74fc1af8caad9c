"""The contacts as the shared unknowns say: where they are, and what patches they have.

    f = ln(F_true / F),  F_true = exp(h) F + b

patches.py tells how the patches follow f and e = ln(E* / nominal) (on a half-space
a ~ exp((f - e)/3), p_0 ~ exp((f + 2 e)/3)). An offset of the indenter, which is fixed in the world,
and of the body move the contact points over the surface; with them turn the contacts' frames and
change the curvatures, and so the patches. Anchored on the body's surface, they go over a paraboloid
and the patches' sizes by slopes: a mesh's normals and curvatures jump a little from face to face.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ...contact import Patches
from ...core import se3
from ...core.errors import CalibrationError
from ...core.se3 import Array
from ..data.global_parameters import GlobalParameters
from .patches import PATCHES_UNDER_LOAD, LoadDerivatives
from .slopes import SurfaceGradients

if TYPE_CHECKING:
    from ...geometry.body import Body
    from ..data.measurements import Measurements

FAR = 20.0
"""Standard deviations of a prior at which it ends."""
LIFTS = 2
"""Steps in which the moved centre finds its height: each leaves the square of the frame's turn."""
FEET = 6
"""Steps in which a foot is found on the paraboloid: each leaves as little."""


@dataclass(frozen=True)
class Contacts:
    """m contacts as the shared unknowns say, and how they change with them."""

    points: Array
    """(m, 3), body frame, m."""
    normals: Array
    """(m, 3)."""
    directions: Array
    """Unit tangents (m, 3) along the patches' first semi-axes."""
    patches: Patches
    """Semi-axes, m, and peaks p_0, Pa, of m contacts."""
    shape: tuple[Array, ...]
    """Derivatives (m, ks) in s of what the contact model calls the shape (`patches.Means`)."""
    log_peak: Array
    """d ln p_0 / ds (m, ks)."""
    moves: Array | None
    """Moves (m, 6, ks) of the contacts' frames in s: of the points, m, and turns, rad; or None."""

    @property
    def radii(self) -> Array:
        """Radii (m,), m, of the circles of the patches' areas."""
        return np.asarray(np.sqrt(self.patches.first * self.patches.second))

    @property
    def peaks(self) -> Array:
        """p_0 (m,), Pa."""
        return np.asarray(self.patches.peak)


class LinearizedContacts:
    """The contacts of a recording about values of the shared unknowns; the last ones are kept."""

    def __init__(
        self, shared: GlobalParameters, recorded: Measurements, body: Body, about: Array
    ) -> None:
        """About s (ks,). Raises CalibrationError if the indenter's offset is unknown and the
        headings are, too.
        """
        self.shared, self.recorded, self.body = shared, recorded, body
        self.data = recorded
        """The measurements with the contacts where s puts them."""
        self.slopes: SurfaceGradients | None = None
        """How patches change from there; None where no contact moves."""
        self._last: tuple[Array, Contacts] | None = None
        if "indenter_offset" in shared.names and recorded.headings is None:
            raise CalibrationError(
                "an unknown indenter offset needs the body's orientation in every contact",
                value="belief.headings = None",
                remedy="record qw qx qy qz of every contact, give belief.headings (m, 3, 3), world "
                "from body, or leave it out",
            )
        if shared.moving:
            # The recorded points are on the believed surface only as well as they were recorded.
            self.data = self._placed(about)
            self.slopes = SurfaceGradients.about(self.data, body)

    def at(self, s: Array) -> Contacts:
        """The contacts at s (ks,)."""
        s = self._within(s)
        if self._last is None or not np.array_equal(self._last[0], s):
            fixed = self._fixed(s)
            self._last = s.copy(), fixed if self.slopes is None else self._moved(fixed, s)
        return self._last[1]

    def check(self, s: Array) -> None:
        """Raise ContactError where the contacts at s (ks,) leave the contact model's series."""
        data, e = self.data, self.shared.value("modulus", self._within(s))
        data.model.patches(
            force=self._force(s),
            curvature=data.curvature,
            indenter_radius=data.indenter_radius,
            effective_modulus=data.modulus * np.exp(e),
        )

    def _fixed(self, s: Array) -> Contacts:
        """The contacts where they are anchored, under the force and E* of s (ks,)."""
        data, at, force = self.data, self.shared.columns, self._force(s)
        patches, rates = self._pressed(data, s)
        load = np.zeros((len(force), len(s)))  # of ln(F/E*)
        if "force_scale" in at:
            scale = np.exp(self.shared.value("force_scale", self._within(s)))
            load[:, at["force_scale"]] = (scale * data.force / force)[:, None]
        if "force_offset" in at:
            load[:, at["force_offset"]] = 1 / force[:, None]
        if "modulus" in at:
            load[:, at["modulus"]] = -1.0
        log_peak = rates.peak * load
        if "modulus" in at:
            log_peak[:, at["modulus"]] += 1.0
        shape = tuple(rate * load for rate in rates.shape)
        return Contacts(data.points, data.normals, data.directions, patches, shape, log_peak, None)

    def _moved(self, fixed: Contacts, s: Array) -> Contacts:
        """The contacts where s (ks,) puts them, from what they are at the anchor."""
        slopes, k = self.slopes, self.data.curvature
        assert slopes is not None
        height = self._height(s)
        centre, up, _ = self._centres(s, height)
        frame = np.stack(
            [fixed.directions, np.cross(fixed.normals, fixed.directions), fixed.normals], axis=1
        )
        goal = np.einsum("mai,mi->ma", frame, centre - fixed.points)
        along_up = np.einsum("mai,mi->ma", frame, up)
        foot, normal, lift = _foot(k, goal, along_up, height)
        step, normal = (np.einsum("mai,ma->mi", frame, part) for part in (foot, normal))
        along = fixed.directions - normal * np.einsum("mi,mi->m", normal, fixed.directions)[:, None]
        along /= np.linalg.norm(along, axis=1)[:, None]
        sides = np.stack([along, np.cross(normal, along)], axis=1)
        # it keeps its height: what s lifts is let down again along `up`; and the foot of a centre
        # at the height h goes 1 / (1 + h k) of its way along each axis
        into = self._centres(s, height + lift)[2]
        risen = np.einsum("mi,mik->mk", normal, into)
        into = into - up[:, :, None] * (risen / np.einsum("mi,mi->m", normal, up)[:, None])[:, None]
        way = sides @ into / (1 + height[:, None] * k)[:, :, None]
        moves = np.einsum("mai,mak->mik", sides, way)
        turns = np.cross(normal[:, :, None], np.einsum("mai,ma,mak->mik", sides, k, way), axis=1)
        turns += normal[:, :, None] * np.einsum("mi,mik->mk", slopes.spin, moves)[:, None]
        bends = [
            np.einsum("mi,mik->mk", slope, moves)
            for slope in (slopes.first, slopes.second, slopes.exponent, slopes.peak)
        ]
        spin = np.einsum("mi,mi->m", slopes.spin, step)[:, None]
        return Contacts(
            points=fixed.points + step,
            normals=normal,
            directions=np.cos(spin) * along + np.sin(spin) * np.cross(normal, along),
            patches=slopes.patches(fixed.patches, step),
            shape=tuple(a + b for a, b in zip(fixed.shape, bends[:3], strict=False)),
            log_peak=fixed.log_peak + bends[3],
            moves=np.concatenate([moves, turns], axis=1),
        )

    def _placed(self, s: Array) -> Measurements:
        """The contacts nearest to the indenter's centres as moved by s (ks,).

        What was recorded is the foot of the centre, not its height: that is such that the moved
        centre presses as deep as its force says.
        """
        height = self._height(s)
        centre, up, _ = self._centres(s, height)
        for _ in range(LIFTS):
            hit = self.body.closest(centre)
            centre = centre + (height - hit.distance)[:, None] * up
        return self.recorded.on(self.body.closest(centre))

    def _height(self, s: Array) -> Array:
        """Heights (m,), m, of the indenter's centres over their contacts at s (ks,)."""
        return self.recorded.indenter_radius - self._pressed(self.recorded, s)[0].depth

    def _centres(self, s: Array, height: Array) -> tuple[Array, Array, Array]:
        """The indenter's centres (m, 3), m, body frame, as moved by s (ks,) from `height` (m,), m,
        over the recorded contacts; the direction (m, 3) of their heights, and d centre / ds
        (m, 3, ks).
        """
        at, up = self.shared.columns, self.recorded.normals
        centre = self.recorded.points + height[:, None] * up
        into = np.zeros((len(centre), 3, len(s)))
        if "body_offset" in at:
            shift, turn = np.split(s[at["body_offset"]], 2)
            rotation = se3.exp_so3(turn)
            centre, up = centre @ rotation.T, up @ rotation.T
            arms = -se3.hat(centre) @ se3.left_jacobian(turn)
            into[:, :, at["body_offset"]] = np.concatenate(
                [np.broadcast_to(np.eye(3), arms.shape), arms], axis=2
            )
            centre = centre + shift
        if "indenter_offset" in at and self.recorded.headings is not None:
            back = np.swapaxes(self.recorded.headings, 1, 2)
            centre = centre + back @ s[at["indenter_offset"]]
            into[:, :, at["indenter_offset"]] = back
        return centre, up, into

    def _pressed(self, data: Measurements, s: Array) -> tuple[Patches, LoadDerivatives]:
        """The patches of `data` under the force and E* of s (ks,)."""
        change = np.log(self._force(s) / data.force)
        return PATCHES_UNDER_LOAD[data.model.name](
            data, change, self.shared.value("modulus", self._within(s))
        )

    def _within(self, s: Array) -> Array:
        # Beyond its priors' far end a trial step of the optimiser changes no more.
        return np.clip(s, -FAR * self.shared.sigma, FAR * self.shared.sigma)

    def _force(self, s: Array) -> Array:
        """True forces (m,), N."""
        h, b = (self.shared.value(n, self._within(s)) for n in ("force_scale", "force_offset"))
        return np.maximum(np.exp(h) * self.recorded.force + b, 0.01 * self.recorded.force)


def _foot(curvature: Array, goal: Array, up: Array, height: Array) -> tuple[Array, Array, Array]:
    """Feet (m, 3), m, on paraboloids z = -(k_1 x^2 + k_2 y^2) / 2, normals (m, 3) and lifts (m,).

    Of centres at `height` (m,), m, over their feet, k being the `curvature` (m, 2), 1/m: each is
    where foot + height * normal = `goal` (m, 3) + lift * `up` (m, 3), in its contact's frame.
    """
    flat, lift = np.zeros((len(goal), 2)), np.zeros(len(goal))
    for _ in range(FEET):
        normal = np.column_stack([curvature * flat, np.ones(len(flat))])
        normal /= np.linalg.norm(normal, axis=1)[:, None]
        off = goal + lift[:, None] * up - height[:, None] * normal
        flat = flat + (off[:, :2] - flat) / (1 + height[:, None] * curvature)
        lift = lift - (off[:, 2] + np.sum(curvature * flat**2, axis=1) / 2) / up[:, 2]
    return np.column_stack([flat, -np.sum(curvature * flat**2, axis=1) / 2]), normal, lift
