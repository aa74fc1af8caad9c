"""The contacts as functions of the global parameters s: where they are, and their patches.

    f = ln(F_true / F),  F_true = exp(h + drift) F + b,  e = ln(E* / nominal)

patch_derivatives.py gives the patches' dependence on f and e. An offset of the indenter, constant
in the world frame, and of the body move the contact points over the surface; the contacts' frames
rotate with them, and the curvatures change, hence the patches. From where they are linearized,
contacts move on a paraboloid, and the patches' sizes follow first-order gradients: a mesh's normals
and curvatures change discontinuously from face to face.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...contact import Patches
from ...core import se3
from ...core.arrays import Array
from ...core.errors import CalibrationError
from ..data.global_parameters import MIN_KEPT, MOTION
from ..data.measurements import Measurements
from .contact_state import Contacts, with_own_size
from .friction import Shears
from .patch_derivatives import (
    LoadDerivatives,
    SurfaceGradients,
    closest_on_paraboloids,
    loaded_patches,
    stretched,
)

MAX_SIGMAS = 20.0
"""Prior standard deviations at which the global parameters are clipped, so that no trial step of
the optimizer overflows; far beyond any estimate."""
HEIGHT_ITERATIONS = 2
"""Iterations that bring the moved centre to its height over the body: each reduces the error by the
squared rotation of the normal, which is small."""
MIN_COSINE = 0.8
"""Cosine of the angle between recorded normal and that of the surface, below which a contact keeps
its height along the latter: at a crease of a mesh they differ, and the iterations would diverge."""


class LinearizedContacts:
    """The contacts of a recording near values of the global parameters; keeps the last ones."""

    def __init__(self, recorded: Measurements, about: Array) -> None:
        """Linearized at s = `about` (ks,).

        Raises CalibrationError if the indenter's offset is unknown and so are the headings.
        """
        self.parameters, self.recorded, self.about = recorded.parameters, recorded, about.copy()
        self.data = recorded
        """The measurements with the contacts where s puts them."""
        self.gradients: SurfaceGradients | None = None
        """How patches change from there; None where no contact moves."""
        self._last: tuple[Array, Contacts] | None = None
        self._shears = Shears(recorded)
        if "indenter_offset" in self.parameters.names and recorded.headings is None:
            raise CalibrationError(
                "an unknown indenter offset needs the body's orientation in every contact",
                value="belief.headings = None",
                remedy="record qw qx qy qz of every contact, give belief.headings (m, 3, 3), world "
                "from body, or leave it out",
            )
        if self.parameters.move_contacts:
            # The recorded points are on the believed surface only as well as they were recorded.
            self.data = self._relocated(about)
            self.gradients = SurfaceGradients.at(self.data)

    def near(self, recorded: Measurements, about: Array) -> LinearizedContacts:
        """The contacts of `recorded` linearized at s = `about` (ks,): these, if they are; the
        patches of contacts that move take most of the time of a linearization."""
        same = self.gradients is None or np.array_equal(self.about, about)
        return self if same and recorded is self.recorded else LinearizedContacts(recorded, about)

    def at(self, s: Array) -> Contacts:
        """The contacts at s (ks,)."""
        s = self._clipped(s)
        if self._last is None or not np.array_equal(self._last[0], s):
            first, *others = (self._of_group(s, g) for g in range(self.parameters.groups))
            self._last = s.copy(), replace(first, others=tuple(others))
        return self._last[1]

    def _of_group(self, s: Array, group: int) -> Contacts:
        """The contacts with the response of a group."""
        found = self._fixed(s, group)
        if self.gradients is not None:
            found = self._moved(found, s)
        if self.recorded.contact_errors is not None:
            found = replace(self._displaced(found, s, self.recorded.contact_errors), by_load=())
        return found

    def log_growth(self, s: Array) -> float:
        """Logarithm of the patches' radii at s (ks,) over the nominal ones, in the median, of the
        group where it is largest."""
        each = self.at(s).each
        return max(float(np.median(np.log(x.radii / self.recorded.radii))) for x in each)

    def with_errors(self, s: Array, errors: Array) -> Contacts:
        """The contacts at s (ks,) with errors (m, 3) of their own: displacements along the patch's
        semi-axes, m, and errors of ln F; predictions then have derivatives in these, too."""
        first, *others = (self._displaced(x, s, errors) for x in self.at(s).each)
        return replace(first, others=tuple(others))

    def _displaced(self, contacts: Contacts, s: Array, errors: Array) -> Contacts:
        moved = contacts.points + errors[:, :1] * contacts.directions
        moved += errors[:, 1:2] * contacts.across
        load = errors[:, 2]
        # with compression, too, the errors are those of a reading at the typical level
        compression = self.parameters.value("compression", contacts.s)
        amplified = 1 + self.recorded.response_levels[1] * compression
        # learned exponents are those of the measured forces, which errors of these make smaller
        derivatives = self._patches(self.data, self._clipped(s), contacts.group)[1]
        by_model = (np.ravel(x) for x in (*derivatives.shape, derivatives.peak))
        slopes = tuple(amplified * np.broadcast_to(slope, len(load)) for slope in by_model)
        if "exponents" in self.parameters.names:
            levels = self.recorded.response_levels
            contacts, slopes = with_own_size(contacts, self.parameters, levels, slopes, load)
        first, second = slopes[0], slopes[1 if len(slopes) > 2 else 0]
        patches = contacts.patches._replace(
            first=contacts.patches.first * np.exp(first * load),
            second=contacts.patches.second * np.exp(second * load),
            peak=contacts.patches.peak * np.exp(slopes[-1] * load),
        )
        return replace(contacts, points=moved, patches=patches, by_load=slopes, load_errors=load)

    def check(self, s: Array) -> None:
        """Raise ContactError where the contacts at s (ks,) are outside the model's range."""
        data, e = self.data, self.parameters.value("modulus", self._clipped(s))
        data.model.patches(
            force=self._force(s),
            curvature=data.curvature,
            indenter_radius=data.belief.indenter.radius,
            effective_modulus=data.modulus * np.exp(e),
        )

    def _fixed(self, s: Array, group: int) -> Contacts:
        """The contacts where they were linearized, under the force and E* of s (ks,), with the
        response of a group."""
        data, at, force = self.data, self.parameters.columns_of(group), self._force(s)
        patches, derivatives = self._patches(data, s, group)
        # d ln(F/E*) / ds, by columns: memory of those of the profile, which are zero, is not used
        load = np.zeros((len(force), len(s)), order="F")
        if "force_scale" in at:
            load[:, at["force_scale"]] = (self._scaled(s) / force)[:, None]
        if "force_offset" in at:
            load[:, at["force_offset"]] = 1 / force[:, None]
        if "force_drift" in at:
            load[:, at["force_drift"]] = (self._scaled(s) / force)[:, None] * data.drifts
        if "modulus" in at:
            load[:, at["modulus"]] = -1.0
        loads = load.any(axis=0)

        def by_load(slope: Array) -> Array:
            found = np.zeros(load.shape, order="F")
            found[:, loads] = slope * load[:, loads]
            return found

        log_peak = by_load(derivatives.peak)
        if "modulus" in at:
            log_peak[:, at["modulus"]] += 1.0
        shape = tuple(map(by_load, derivatives.shape))
        if "scale" in at:
            log_peak[:, at["scale"]] = 1.0
            patches = patches._replace(peak=patches.peak * np.exp(s[at["scale"]][0]))
        if "gain_drift" in at:
            log_peak[:, at["gain_drift"]] = data.drifts
            drifted = np.exp(data.drifts @ s[at["gain_drift"]])
            patches = patches._replace(peak=patches.peak * drifted)
        compression = self.parameters.value("compression", s, group)
        if "compression" in at:  # readings at the typical level stay
            level = data.response_levels[0]
            kept = max(1 - level * compression, MIN_KEPT)
            log_peak[:, at["compression"]] = level / kept
            patches = patches._replace(peak=patches.peak / kept)
        if "exponents" in at:
            patches = self._rescaled(patches, shape, log_peak, s, at["exponents"])
        if "aspect" in at:
            patches = stretched(patches, shape, s[at["aspect"]][0], at["aspect"].start)
        return Contacts(
            data.points, data.normals, data.directions, patches, shape, log_peak, None, s,
            profile=s[at["profile"]] if "profile" in at else np.empty(0), compression=compression,
            group=group,
        )  # fmt: skip

    def _rescaled(
        self, patches: Patches, shape: tuple[Array, ...], log_peak: Array, s: Array, columns: slice
    ) -> Patches:
        """The patches with the exponents of s (ks,) in the load; writes the derivatives by these.

        Their size grows with force times relative radius of curvature, the peak such that the
        force is balanced, but for an exponent of its own in the force.
        """
        data, exponents = self.data, s[columns]
        force = np.log(data.force / (data.belief.force_reference or 1.0)) + self._drift(s)
        size = force - np.log(data.relative_curvature / data.typical_curvature)
        for slope in shape[:2]:
            slope[:, columns.start] = size
        log_peak[:, columns.start : columns.start + 2] = np.column_stack([-2 * size, force])
        if drift := self.parameters.columns.get("force_drift"):
            for slope in shape[:2]:
                slope[:, drift] += exponents[0] * data.drifts
            log_peak[:, drift] += (exponents[1] - 2 * exponents[0]) * data.drifts
        grown = np.exp(exponents[0] * size)
        return patches._replace(
            first=patches.first * grown,
            second=patches.second * grown,
            peak=patches.peak * np.exp(log_peak[:, columns] @ exponents),
        )

    def _moved(self, fixed: Contacts, s: Array) -> Contacts:
        """The contacts at s (ks,), moved from the point of linearization."""
        gradients, height = self.gradients, self._heights(s)
        assert gradients is not None
        k = self.data.curvature
        centre, up, _ = self._centres(s, height)
        steep = np.sum(up * fixed.normals, axis=1) < MIN_COSINE
        up = np.where(steep[:, None], fixed.normals, up)
        frame = np.stack(
            [fixed.directions, np.cross(fixed.normals, fixed.directions), fixed.normals], axis=1
        )
        goal = np.einsum("mai,mi->ma", frame, centre - fixed.points)
        foot, normal, lift = closest_on_paraboloids(
            k, goal, np.einsum("mai,mi->ma", frame, up), height
        )
        step, normal = (np.einsum("mai,ma->mi", frame, part) for part in (foot, normal))
        first = fixed.directions - normal * np.einsum("mi,mi->m", normal, fixed.directions)[:, None]
        first /= np.linalg.norm(first, axis=1)[:, None]
        sides = np.stack([first, np.cross(normal, first)], axis=1)
        # The height is constant: what s lifts is lowered along `up`; the closest point of a centre
        # at height h moves by 1 / (1 + h k) of the centre's motion along each principal axis.
        motion = self._centres(s, height + lift)[2]
        rise = np.einsum("mi,mik->mk", normal, motion)
        cosine = np.einsum("mi,mi->m", normal, up)[:, None]
        motion = motion - up[:, :, None] * (rise / cosine)[:, None]
        along = sides @ motion / (1 + height[:, None] * k)[:, :, None]
        moves = np.einsum("mai,mak->mik", sides, along)
        turns = np.cross(normal[:, :, None], np.einsum("mai,ma,mak->mik", sides, k, along), axis=1)
        turns += normal[:, :, None] * np.einsum("mi,mik->mk", gradients.spin, moves)[:, None]
        *bends, by_peak = (
            np.einsum("mi,mik->mk", slope, moves)
            for slope in (gradients.first, gradients.second, gradients.exponent, gradients.peak)
        )
        spin = np.einsum("mi,mi->m", gradients.spin, step)[:, None]
        return replace(
            fixed,
            points=fixed.points + step,
            normals=normal,
            directions=np.cos(spin) * first + np.sin(spin) * np.cross(normal, first),
            patches=gradients.patches(fixed.patches, step),
            shape=tuple(a + b for a, b in zip(fixed.shape, bends, strict=False)),
            log_peak=fixed.log_peak + by_peak,
            moves=np.concatenate([moves, turns], axis=1),
        )

    def _relocated(self, s: Array) -> Measurements:
        """The contacts closest to the indenter's centres as moved by s (ks,).

        The recording holds the centre's closest point, not its height, which is such that the moved
        centre presses as deep as its force requires.
        """
        height = self._heights(s)
        centre, up, _ = self._centres(s, height)
        for _ in range(HEIGHT_ITERATIONS):
            hit = self.data.body.closest(centre)
            centre = centre + (height - hit.distance)[:, None] * up
        return self.recorded.at_contacts(self.data.body.closest(centre))

    def _heights(self, s: Array) -> Array:
        """Heights (m,), m, of the indenter's centres over their contacts at s (ks,)."""
        radius = self.recorded.belief.indenter.radius
        return radius - self._patches(self.recorded, s)[0].depth

    def _centres(self, s: Array, height: Array) -> tuple[Array, Array, Array]:
        """The indenter's centres (m, 3), m, body frame, as moved by s (ks,) from `height` (m,), m,
        over the recorded contacts; the direction (m, 3) of their heights, and d centre / ds
        (m, 3, ks).
        """
        at, up = self.parameters.columns, self.recorded.normals
        centre = self.recorded.points + height[:, None] * up
        slope = np.zeros((len(centre), 3, len(s)))
        if "body_offset" in at:
            shift, turn = np.split(s[at["body_offset"]], 2)
            rotation = se3.exp_so3(turn)
            centre, up = centre @ rotation.T, up @ rotation.T
            arms = -se3.hat(centre) @ se3.left_jacobian(turn)
            slope[:, :, at["body_offset"]] = np.concatenate(
                [np.broadcast_to(np.eye(3), arms.shape), arms], axis=2
            )
            centre = centre + shift
        if "indenter_offset" in at and self.recorded.headings is not None:
            back = np.swapaxes(self.recorded.headings, 1, 2)
            centre = centre + back @ s[at["indenter_offset"]]
            slope[:, :, at["indenter_offset"]] = back
        # a contact moves less than its centre on a convex body
        grown = (1 + height * self.recorded.curvature.mean(axis=1))[:, None]
        if "drag" in at:
            slope[:, :, at["drag"].start] = back = -grown * self.recorded.headway
            centre = centre + s[at["drag"]] * back
        if "friction" in at:
            shear, by_limit = self._shears(self.parameters.value("friction", s))
            centre, slope[:, :, at["friction"].start] = centre - grown * shear, -grown * by_limit
        if "patch_shift" in at:
            slope[:, :, at["patch_shift"].start] = along = grown * self.recorded.patch_shifts
            centre = centre + s[at["patch_shift"]] * along
        if self.parameters.motion is not None:
            motion = self.parameters.motion
            centre = centre + motion.displacements(s[at[MOTION]])
            slope[:, :, at[MOTION]] = motion.slopes @ motion.root
        return centre, up, slope

    def _patches(
        self, data: Measurements, s: Array, group: int = 0
    ) -> tuple[Patches, LoadDerivatives]:
        """The patches of `data` under the force and E*, of a group's taxels, of s (ks,)."""
        log_modulus = self.parameters.value("modulus", self._clipped(s), group)
        return loaded_patches(data, np.log(self._force(s) / data.force), log_modulus)

    def _clipped(self, s: Array) -> Array:
        limit = MAX_SIGMAS * self.parameters.sigma
        return np.clip(s, -limit, limit)

    def _force(self, s: Array) -> Array:
        """True forces (m,), N."""
        offset = self.parameters.value("force_offset", self._clipped(s))
        return np.maximum(self._scaled(s) + offset, 0.01 * self.recorded.force)

    def _scaled(self, s: Array) -> Array:
        """True forces (m,), N, without their offset."""
        s = self._clipped(s)
        log_scale = self.parameters.value("force_scale", s) + self._drift(s)
        return np.asarray(np.exp(log_scale) * self.recorded.force)

    def _drift(self, s: Array) -> Array | float:
        """Drift (m,) of ln F of the measured forces; 0 without one."""
        at = self.parameters.columns.get("force_drift")
        return 0.0 if at is None else self.recorded.drifts @ self._clipped(s)[at]
