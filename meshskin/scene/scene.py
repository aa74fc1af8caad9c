"""The scene: a skinned body, an arm that carries it, the indenter, and the effects that are on.

A scene is the world that `simulate` gets. `Scene.belief` is what the robot's owner knows of it,
which is what `calibrate` gets: no taxel's pose is in it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..contact import AUTO, BATCHED, ContactModel, Patch
from ..contact.indenter import Indenter
from ..contact.material import Indentation, Material
from ..contact.reading import ReadingModel
from ..core.arguments import check_name, check_real, check_type, replace_fields, repr_short
from ..core.errors import ConfigError, SkinError
from ..core.se3 import Array, is_rigid, orthonormal_basis, perpendicular, transform
from ..effects import Context, NoiseEffect, check_effect
from ..geometry.body import Body
from ..robot.arm import Arm
from ..robot.contact_rig import ContactRig
from ..skin import slots
from ..skin.modules import Modules
from ..skin.skin import Skin
from . import shipped_scenes
from .belief import Belief
from .settings import Exploration, Law, Loop, Readout

if TYPE_CHECKING:
    from ..effects import Effect

BENT = 1e-5
"""Most that a taxel of a rigid module lies off its place, m: less than it is found to."""
ADAPTER = 0.02
"""Length of the piece between flange and body when no mount is given, m."""


LEAST_BUDGET = 1e-9
"""Least error budget, m: so far apart do models that agree put the taxels, by rounding."""
PARTS: dict[str, type] = {
    "body": Body, "skin": Skin, "indenter": Indenter, "arm": Arm, "material": Material,
    "law": Law, "exploration": Exploration, "readout": Readout, "loop": Loop,
}  # fmt: skip
"""Parts that every scene has."""


@dataclass(frozen=True)
class Scene:
    """A skinned body on an arm over a fixed indenter."""

    body: Body
    skin: Skin
    indenter: Indenter = field(default_factory=Indenter)
    arm: Arm = field(
        default_factory=lambda: Arm.from_urdf(shipped_scenes.folder() / "puma560.urdf")
    )
    material: Material = field(default_factory=Material)
    law: Law = field(default_factory=Law)
    exploration: Exploration = field(default_factory=Exploration)
    readout: Readout = field(default_factory=Readout)
    loop: Loop = field(default_factory=Loop)
    effects: tuple[Effect, ...] = ()
    candidates: tuple[Effect, ...] | None = None
    """What an error budget may put on beside `effects`; None: every registered effect."""
    budget: float | None = None
    """Taxel error, m, that may be left out: `ms.budget` decides what is on. None: it is decided."""
    contact: str = AUTO
    """Contact model: of physics.contact.BATCHED, or "auto", the first of them that holds at every
    taxel where any does."""
    payload: float = 1.0
    """Mass of the body, kg, spread evenly over its volume."""
    mount: Array | None = None
    """T_tip_body (4, 4); None: the skin faces along the tip's z axis, behind a 20 mm adapter."""
    name: str = "scene"
    description: str = ""

    def __post_init__(self) -> None:
        if self.arm is None:
            raise ConfigError(
                "a scene without an arm",
                remedy="leave it out for the default one, which a quasi-static loop does not use",
            )
        for name, kind in PARTS.items():
            check_type(kind, getattr(self, name), f"the {name} of a scene")
        if self.mount is not None and not is_rigid(self.mount):
            limit = "a finite (4, 4) with a rotation in it"
            shape = np.shape(self.mount)
            value = shape if shape != (4, 4) else repr_short(self.mount)
            raise ConfigError("a mount is T_tip_body", value=value, limit=limit)
        check_real("payload of a scene", self.payload, "kg", least=0.0)
        if self.budget is not None:
            check_real("budget of a scene", self.budget)
            if self.budget < LEAST_BUDGET:
                small = "no setting resolves so small an error budget"
                raise ConfigError(
                    small if self.budget > 0 else "an error budget must be positive",
                    value=f"{1e3 * self.budget:g} mm",
                    limit=f"at least {1e3 * LEAST_BUDGET:g} mm",
                    remedy="for everything on, list the effects in the scene and give no budget",
                )
        check_type(Iterable, self.effects, "what is on in a scene")
        for effect in (*self.effects, *(self.candidates or ())):
            check_effect(effect)

    def __repr__(self) -> str:
        on = ", ".join(type(effect).__name__ for effect in self.effects) or "no effects"
        return f"<Scene {self.name!r}: {self.body!r}, {self.skin!r}, {self.arm!r}, {on}>"

    @classmethod
    def load(cls, name: str | Path) -> Scene:
        """A shipped scene by name, or a scene from a TOML file. Raises ConfigError."""
        from .file import load

        return load(name)

    def with_(self, **changes: Any) -> Scene:
        """This scene with other parts. Raises ConfigError."""
        return replace_fields(self, changes)

    @cached_property
    def axis(self) -> Array:
        """Mean outward normal of the skin (3,), body frame."""
        mean = self.skin.normals.mean(axis=0)
        return np.asarray(mean / np.linalg.norm(mean))

    @cached_property
    def mount_pose(self) -> Array:
        """T_tip_body (4, 4)."""
        if self.mount is not None:
            return np.asarray(self.mount, dtype=float)
        rotation = orthonormal_basis(self.axis, perpendicular(self.axis)).T
        back = -float((self.body.mesh.vertices @ self.axis).min())
        return transform(rotation, [0.0, 0.0, back + ADAPTER])

    @property
    def indentation(self) -> Indentation:
        """The indenter on the skin's material under the reference force."""
        return Indentation(self.law.force_reference, self.indenter.radius, self.material)

    @cached_property
    def model(self) -> ContactModel:
        """The contact model; of "auto", the first that holds at every taxel where any does.

        Raises UnknownNameError.
        """
        check_name("contact model of a scene", self.contact, (*BATCHED, AUTO))
        name = self.contact
        if name == AUTO:
            name = self.indentation.first_valid_model(
                self.body.closest(self.skin.positions).curvature
            )
        return self.indentation.model(name)

    def invalid_reasons(self, curvature: Array) -> Array:
        """Why the contact model does not hold (k,) at principal curvatures (k, 2), 1/m: strings, ""
        where it does.
        """
        return self.indentation.invalid_reasons(self.model.name, curvature)

    def check_contact(self, curvature: Array) -> None:
        """Raise ContactError if the contact model leaves its range at one of (k, 2) curvatures."""
        for k in np.flatnonzero(self.invalid_reasons(curvature) != "")[:1]:
            self.indentation.patch(self.model.name, curvature[k])

    @cached_property
    def patch(self) -> Patch:
        """The contact patch under the reference force at the skin's centre, or at the taxel next
        to it at which the contact model holds. Raises ContactError where there is none.
        """
        positions = self.skin.positions
        near = np.argsort(np.linalg.norm(positions - positions.mean(axis=0), axis=1))
        places = np.concatenate([positions.mean(axis=0)[None], positions[near]])
        curvature = self.body.closest(places).curvature
        good = np.flatnonzero(self.invalid_reasons(curvature) == "")
        return self.indentation.patch(self.model.name, curvature[good[0] if len(good) else 0])

    @property
    def threshold(self) -> float:
        """Pressure up to which a reading is not reported, Pa."""
        return self.readout.threshold_relative * self.patch.peak

    @property
    def reading_model(self) -> ReadingModel:
        """How contacts become pressures where no effect changes it."""
        return ReadingModel(
            self.model,
            self.skin.disc_radius,
            self.indenter.radius,
            self.material.effective_modulus,
        )

    def context(self, seed: int) -> Context:
        """What the effects may know when they are built."""
        return Context(
            seed=seed,
            peak_pressure=self.patch.peak,
            contact_radius=float(self.patch.semi_axes[0]),
            force=self.law.force_reference,
            indenter_radius=self.indenter.radius,
            indenter_position=np.array(self.indenter.position),
            shear_modulus=self.material.young / (2.0 * (1.0 + self.material.poisson)),
            poisson=self.material.poisson,
            period=self.frame_steps * self.loop.dt,
            speed=self.exploration.speed,
            skin=self.skin,
            body=self.body,
            reading_model=self.reading_model,
            pose=self.body_pose,
            postures=lambda: self.postures,
            joints=len(self.arm.joint_names) if self.loop.mode == "arm" else 0,
        )

    @cached_property
    def postures(self) -> Array:
        """Configurations (k, n) in which the arm may hold the skin on the indenter."""
        if self.loop.mode != "arm":
            return np.zeros((0, 0))
        return self.rig.postures(self.skin.positions)

    @cached_property
    def rig(self) -> ContactRig:
        """The arm with the body over the indenter, at the contact patch of the reference force."""
        return self.rig_of(self.patch, self.invalid_reasons)

    def rig_of(
        self, patch: Patch, model_reasons: Callable[[Array], Array] | None = None
    ) -> ContactRig:
        """The contact rig at another contact patch; model_reasons: as in ContactRig."""
        return ContactRig(
            self.body,
            self.indenter,
            depth=patch.depth,
            sensing_radius=float(patch.semi_axes[-1]) + self.skin.disc_radius,
            arm=self.arm if self.loop.mode == "arm" else None,
            mount=self.mount_pose,
            patch_radius=float(patch.semi_axes[0]),
            model_reasons=model_reasons,
        )

    @property
    def frame_steps(self) -> int:
        """Steps of the closed loop from frame to frame."""
        return max(round(1.0 / (self.readout.rate * self.loop.dt)), 1)

    def body_pose(self, q: Array) -> Array:
        """T_w_body (k, 4, 4) in configurations (k, n): joint angles, or, without an arm, position
        and quaternion.
        """
        if self.loop.mode == "arm":
            return np.asarray(self.arm.pose(q) @ self.mount_pose)
        from ..core.se3 import poses_of_states

        return poses_of_states(q)

    def belief(self, **changes: Any) -> Belief:
        """What the owner of this scene knows; `changes` replace fields (a softer material, ...).

        Raises ConfigError for what is no field of a Belief, or no value of it.
        """
        context = self.context(0)
        sigma = [e.sigma(context) for e in self.effects if isinstance(e, NoiseEffect)]
        known = Belief(
            body=self.body,
            indenter=self.indenter,
            material=self.material,
            contact=self.model.name,
            taxel_ids=np.array(self.skin.ids),
            disc_radius=self.skin.disc_radius,
            force_reference=self.law.force_reference,
            noise_sigma=float(np.sqrt(np.sum(np.square(sigma)))) if sigma else None,
            threshold=self.threshold,
            module_slots=self._module_slots(),
        )
        return replace_fields(known, changes)

    def _module_slots(self) -> Array | None:
        """What a data sheet says of rigid modules, where the skin is of such; not their poses."""
        try:
            Modules.of(self.skin, BENT)
        except SkinError:
            return None
        return slots.OFFSETS
