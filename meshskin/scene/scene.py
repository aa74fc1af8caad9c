"""The scene: a skinned body, an arm that carries it, the indenter, and the effects that are on.

Five objects carry the facts of a run, each made from those before it: the Scene (the world), the
Plan (the path of the contact point, `plan_exploration(scene)`), the Recording (contacts and
readings, `simulate(scene)`), the Belief (what the robot's owner knows, `scene.belief()`: no taxel's
pose is in it), and the Calibration (`calibrate(recording, belief)`). All else is a view of a scene
for one use: `Scene.rig` for the planner, `Scene.context` for the effects, `Scene.reading_model` for
the sensors, and the ClosedLoopModel of the simulation for its step function.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..contact import AUTO, BATCHED, ContactModel, Patch
from ..contact.indenter import Indenter
from ..contact.material import Indentation, Material
from ..contact.reading import ReadingModel
from ..core.arguments import (
    NamedFields,
    check_integer,
    check_name,
    check_real,
    check_type,
    replace_fields,
    repr_short,
)
from ..core.arrays import Array
from ..core.errors import ConfigError
from ..core.notebook import Card
from ..core.se3 import is_rigid, orthonormal_basis, perpendicular, poses_of_states, transform
from ..core.value import Value
from ..effects import Context, Effect, NoiseEffect, check_effect
from ..geometry.body import Body
from ..robot.arm import Arm
from ..robot.contact_rig import ContactRig
from ..skin.skin import Skin
from . import shipped_scenes
from .belief import Belief, module_slots
from .file import read_tables, scene_fields
from .settings import Exploration, Law, Loop, Readout

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ADAPTER = 0.02
"""Length of the adapter between flange and body where no mount is given, m. Chosen."""
MIN_MEAN_NORMAL = 0.05
"""Least length of a skin's mean normal that gives its axis. Skins all round a body have 0.003 to
0.018 (lattices of 5 to 15 mm on sphere, capsule, torus, ellipsoid), a half sphere has 0.5."""
MIN_BUDGET = 1e-9
"""Least error budget, m: positions by equal models differ by as much through rounding."""
PARTS: dict[str, type] = {
    "body": Body, "skin": Skin, "indenter": Indenter, "arm": Arm, "material": Material,
    "law": Law, "exploration": Exploration, "readout": Readout, "loop": Loop,
}  # fmt: skip
"""Types of the parts that every scene has."""


@dataclass(frozen=True, eq=False)
class Scene(Value, NamedFields, Card):
    """A skinned body on an arm over a fixed indenter.

    Raises ConfigError for an unknown field or a value out of range.
    """

    body: Body
    """The body under the skin."""
    skin: Skin
    """Its taxels, at their true places."""
    indenter: Indenter = field(default_factory=Indenter)
    """What the body is pressed on."""
    arm: Arm = field(
        default_factory=lambda: Arm.from_urdf(shipped_scenes.folder() / "puma560.urdf")
    )
    """The arm that carries the body, or the indenter; by default a Puma 560."""
    material: Material = field(default_factory=Material)
    """The skin's material."""
    law: Law = field(default_factory=Law)
    """Gains of the compliance law."""
    exploration: Exploration = field(default_factory=Exploration)
    """How the contact point covers the skin."""
    readout: Readout = field(default_factory=Readout)
    """How the skin is read."""
    loop: Loop = field(default_factory=Loop)
    """How the closed loop is integrated."""
    effects: tuple[Effect, ...] = ()
    """Effects that are on, in the order of the signal."""
    candidates: tuple[Effect, ...] | None = None
    """Effects that an error budget may add to `effects`; None: every registered effect."""
    budget: float | None = None
    """Taxel error, m, that omitted effects may cause: `ms.budget` decides which are on. None: the
    effects are those listed."""
    contact: str = AUTO
    """Contact model, one of contact.BATCHED, or "auto": the first of them that holds at every taxel
    at which any of them does."""
    payload: float = 1.0
    """Mass of the body, kg, spread evenly over its volume."""
    mount: Array | None = None
    """T_tip_body (4, 4); None: the skin faces along the tip's z axis, behind a 20 mm adapter. With
    an indenter carried by the arm, the pose of the indenter's sphere in the tip's frame, z from the
    support to the sphere; None: the support stands on the tip, along its z axis."""
    name: str = "scene"
    """Name in reports and metrics."""
    description: str = ""
    """One line about the scene."""

    def __post_init__(self) -> None:
        if self.arm is None:
            raise ConfigError(
                "scene.arm must be an Arm, not None",
                remedy="omit it for the default arm, which a quasi-static loop does not use",
            )
        for name, kind in PARTS.items():
            check_type(kind, getattr(self, name), f"the {name} of a scene")
        check_integer("number of a scene's taxels", len(self.skin), least=1)
        if self.indenter.carried_by is not None and self.loop.mode != "quasi_static":
            raise ConfigError(
                f"an indenter carried by {self.indenter.carried_by} needs a body at rest",
                value=f'loop.mode = "{self.loop.mode}"',
                remedy='set loop.mode = "quasi_static"',
            )
        if self.mount is not None and not is_rigid(self.mount):
            shape = np.shape(self.mount)
            raise ConfigError(
                "scene.mount must be a rigid transform T_tip_body",
                value=shape if shape != (4, 4) else repr_short(self.mount),
                limit="a finite (4, 4) with a rotation in it",
            )
        check_real("payload of a scene", self.payload, "kg", least=0.0)
        if self.budget is not None and check_real("budget of a scene", self.budget) < MIN_BUDGET:
            small = "no setting resolves so small an error budget"
            raise ConfigError(
                small if self.budget > 0 else "an error budget must be positive",
                value=f"{1e3 * self.budget:g} mm",
                limit=f"at least {1e3 * MIN_BUDGET:g} mm",
                remedy="for all effects, list them in the scene and give no budget",
            )
        check_name("contact model of a scene", self.contact, (*BATCHED, AUTO))
        check_type(Iterable, self.effects, "scene.effects")
        object.__setattr__(self, "effects", tuple(self.effects))
        for effect in (*self.effects, *(self.candidates or ())):
            check_effect(effect)

    def __repr__(self) -> str:
        on = ", ".join(type(effect).__name__ for effect in self.effects) or "no effects"
        return f"<Scene {self.name!r}: {self.body!r}, {self.skin!r}, {self.arm!r}, {on}>"

    def facts(self) -> dict[str, str]:
        """Name, parts and effects, for a notebook."""
        parts = {name: repr(getattr(self, name)).strip("<>") for name in ("body", "skin", "arm")}
        radius, young = 1e3 * self.indenter.radius, self.material.young / 1e3
        press = f"{radius:.4g} mm radius, {self.law.force_reference:.4g} N on {young:.4g} kPa"
        on = ", ".join(map(repr, self.effects)) or "none"
        return {"name": self.name, **parts, "indenter": press, "effects": on}

    def plot(self, ax: Axes | None = None) -> Figure:
        """Draw the skin on the body; ax: matplotlib axes (None: those of a new figure)."""
        return self.skin.plot(ax, self.body)

    @classmethod
    def load(cls, name: str | Path) -> Scene:
        """A shipped scene by name, or a scene from a TOML file. Raises ConfigError."""
        return cls.from_tables(*read_tables(name))

    @classmethod
    def from_tables(cls, data: Mapping[str, Any], folder: Path) -> Scene:
        """The scene of merged TOML tables; paths start from `folder`. Raises ConfigError."""
        return cls(**scene_fields(data, folder))

    def with_(self, **changes: Any) -> Scene:
        """This scene with other values of some fields. Raises ConfigError."""
        return replace_fields(self, changes)

    @cached_property
    def axis(self) -> Array:
        """Mean outward normal of the skin (3,), body frame; the body's z axis where the skin has
        none because it is all round the body.
        """
        mean = self.skin.normals.mean(axis=0)
        length = np.linalg.norm(mean)
        return np.asarray(mean / length if length > MIN_MEAN_NORMAL else [0.0, 0.0, 1.0])

    @cached_property
    def mount_pose(self) -> Array:
        """T_tip_body (4, 4). Raises ConfigError if an arm has no default mount for the skin."""
        if self.mount is not None:
            return np.asarray(self.mount, dtype=float)
        if self.indenter.carried_by == "arm":
            height = self.indenter.support_height + self.indenter.radius
            return transform(np.eye(3), [0.0, 0.0, height])
        length = float(np.linalg.norm(self.skin.normals.mean(axis=0)))
        if self.loop.mode == "arm" and length <= MIN_MEAN_NORMAL:
            raise ConfigError(
                "a skin all round its body has no side to turn to the indenter",
                value=f"a mean normal of length {length:.2g}",
                limit=f"above {MIN_MEAN_NORMAL:g} for the default mount",
                remedy="give mount=T_tip_body ([arm] mount_m in a scene file)",
            )
        rotation = orthonormal_basis(self.axis, perpendicular(self.axis)).T
        back = -float((self.body.surface.vertices @ self.axis).min())
        return transform(rotation, [0.0, 0.0, back + ADAPTER])

    @property
    def indentation(self) -> Indentation:
        """The indenter on the skin's material under the reference force."""
        return Indentation(self.law.force_reference, self.indenter.radius, self.material)

    @cached_property
    def model(self) -> ContactModel:
        """The contact model; of "auto", the first that holds at every taxel where any does."""
        name = self.contact
        if name == AUTO:
            curvature = self.body.closest(self.skin.positions).curvature
            name = self.indentation.first_valid_model(curvature)
        return self.indentation.model(name)

    def invalid_reasons(self, curvature: Array) -> Array:
        """Reason (k,) why the contact model does not hold at principal curvatures (k, 2), 1/m; ""
        where it does.
        """
        return self.indentation.invalid_reasons(self.model.name, curvature)

    @cached_property
    def patch(self) -> Patch:
        """The contact patch under the reference force at the skin's centre, or at the taxel nearest
        to it at which the contact model holds. Raises ContactError where there is none."""
        return self.indentation.first_patch(self.model.name, self._middle_first)

    @cached_property
    def pressed_patch(self) -> Patch:
        """`patch`, or the patch under a lighter force (material.LIGHTER) where the model holds only
        there, as plans then press. Raises ContactError where it holds under none of these."""
        return self.indentation.lighter_patch(self.model.name, self._middle_first)

    @cached_property
    def _middle_first(self) -> Array:
        """Principal curvatures (n + 1, 2), 1/m, at the skin's centre and the taxels by distance."""
        positions, middle = self.skin.positions, self.skin.positions.mean(axis=0)
        near = np.argsort(np.linalg.norm(positions - middle, axis=1))
        return self.body.closest(np.concatenate([middle[None], positions[near]])).curvature

    @property
    def threshold(self) -> float:
        """Pressure up to which a reading is not recorded, Pa."""
        return self.readout.threshold_relative * self.pressed_patch.peak

    @property
    def reading_model(self) -> ReadingModel:
        """The pressures that contacts cause without effects."""
        return ReadingModel(
            self.model, self.skin.disc_radius, self.indenter.radius, self.material.effective_modulus
        )

    def context(self, seed: int) -> Context:
        """What the effects may know when they are built."""
        return Context(
            seed=seed,
            peak_pressure=self.pressed_patch.peak,
            contact_radius=float(self.pressed_patch.semi_axes[0]),
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
            carried=self.indenter.carried_by is not None,
        )

    @cached_property
    def postures(self) -> Array:
        """Configurations (k, n) in which the arm may hold the skin on the indenter."""
        if self.loop.mode != "arm":
            return np.zeros((0, 0))
        return self.rig.postures(self.skin.positions)

    @cached_property
    def rig(self) -> ContactRig:
        """The arm with the body over the indenter, at the contact patch; see `pressed_patch`."""
        return self.rig_of(self.pressed_patch, self.invalid_reasons)

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
        """Steps of the closed loop per frame of readings."""
        return max(round(1.0 / (self.readout.rate * self.loop.dt)), 1)

    def body_pose(self, q: Array) -> Array:
        """T_w_body (k, 4, 4) in configurations (k, n): joint angles, or, without an arm, position
        and quaternion.
        """
        if self.loop.mode == "arm":
            return np.asarray(self.arm.pose(q) @ self.mount_pose)
        return poses_of_states(q)

    def belief(self, **changes: Any) -> Belief:
        """What the owner of this scene knows; `changes` replace fields (a softer material, ...).

        Raises ConfigError for an unknown field of a Belief or a value out of range.
        """
        context = self.context(0)
        sigma = [e.sigma(context) for e in self.effects if isinstance(e, NoiseEffect)]
        noise = float(np.sqrt(np.sum(np.square(sigma))))
        known = Belief(
            body=self.body,
            indenter=self.indenter,
            material=self.material,
            contact=self.model.name,
            taxel_ids=np.array(self.skin.ids),
            disc_radius=self.skin.disc_radius,
            force_reference=self.law.force_reference,
            noise_sigma=noise if noise > 0 else None,
            threshold=self.threshold,
            module_slots=module_slots(self.skin),
        )
        return replace_fields(known, changes)
