"""Scenarios: variations of the scene in which the gains must meet the demands."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from ..core.arrays import Array
from ..core.config import check_fields, quantity
from ..core.errors import ConfigError
from ..core.se3 import transform
from ..scene.scene import Scene


@dataclass(frozen=True)
class Scenario:
    """A variation of the scene; the law keeps assuming the scene's own parameters."""

    modulus: float = quantity("", 1.0, above=0.0)
    """E* of the contact, relative to that of the scene."""
    curvature: float = quantity("", 1.0, above=0.0)
    """Curvature of the body at the contact, relative to that of the scene."""
    friction: float = quantity("", 0.0, least=0.0)
    """Coulomb friction of each joint, relative to its torque limit, in addition to the arm's own.
    """

    def __post_init__(self) -> None:
        check_fields(self)

    @property
    def name(self) -> str:
        """The differences from the scene, or "nominal"."""
        parts = [f"E* x {self.modulus:g}"] if self.modulus != 1.0 else []
        parts += [f"curvature x {self.curvature:g}"] if self.curvature != 1.0 else []
        parts += [f"friction {100 * self.friction:g} %"] if self.friction else []
        return ", ".join(parts) or "nominal"


def scenarios(
    modulus: tuple[float, float] = (1.0, 1.0),
    curvature: tuple[float, float] = (1.0, 1.0),
    friction: tuple[float, float] = (0.0, 0.0),
) -> tuple[Scenario, ...]:
    """The nominal scenario and the corners of the ranges (lowest, highest); see Scenario."""
    ends = [sorted(set(r)) for r in (modulus, curvature, friction)]
    corners = [Scenario(*corner) for corner in product(*ends)]
    return tuple(dict.fromkeys([Scenario(), *corners]))


def scenario_scene(scene: Scene, scenario: Scenario, place: Array) -> Scene:
    """The scene in a scenario.

    The curvature changes by scaling the body about the contact at `place` (3,), body frame, m.
    Raises ConfigError for friction where the arm has no torque limits.
    """
    changed = scene
    if scenario.modulus != 1.0:
        material, law = scene.material, scene.law
        changed = changed.with_(
            material=replace(material, young=scenario.modulus * material.young),
            law=replace(law, effective_modulus=law.effective_modulus or material.effective_modulus),
        )
    if scenario.curvature != 1.0:
        changed = _scaled(changed, 1.0 / scenario.curvature, place)
    if scenario.friction and scene.loop.mode == "arm":
        arm = scene.arm
        if not np.isfinite(arm.effort_limit).all():
            raise ConfigError(
                f"friction relative to the torque limits of {arm.name} needs finite limits",
                value=arm.effort_limit.tolist(),
                remedy="give efforts in the URDF",
            )
        friction = arm.friction + scenario.friction * arm.effort_limit
        changed = changed.with_(arm=replace(arm, friction=friction))
    return changed


def _scaled(scene: Scene, scale: float, place: Array) -> Scene:
    """The scene with its body `scale` times as large; the point `place` stays where it is."""
    import trimesh

    body, skin = scene.body, scene.skin
    mesh = trimesh.Trimesh(scale * body.mesh.vertices, body.mesh.faces, process=False)
    poses = skin.poses.copy()
    poses[:, :3, 3] *= scale
    shift = transform(np.eye(3), (1.0 - scale) * np.asarray(place))
    return scene.with_(
        body=replace(body, mesh=mesh, exact=None, robot_mesh=None),
        skin=replace(skin, poses=poses),
        mount=scene.mount_pose @ shift,
    )
