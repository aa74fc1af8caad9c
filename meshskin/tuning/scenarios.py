"""The worlds of the scenarios as scenes: what the problem shoots through and the simulator runs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..core.errors import ConfigError
from ..core.se3 import Array, transform
from ..scene.scene import Scene
from .gains import Scenario


def world(scene: Scene, scenario: Scenario, place: Array) -> Scene:
    """The scene in a scenario; the law keeps believing in the scene's own E*.

    The curvature changes by scaling the body about the contact at `place` (3,), body frame. Raises
    ConfigError for friction where the arm gives no torque limits.
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
                f"friction of {arm.name} as a part of its torque limits",
                value=arm.effort_limit.tolist(), remedy="give efforts in the URDF",
            )  # fmt: skip
        friction = arm.friction + scenario.friction * arm.effort_limit
        changed = changed.with_(arm=replace(arm, friction=friction))
    return changed


def _scaled(scene: Scene, scale: float, place: Array) -> Scene:
    """The scene with its body `scale` times as large, the point `place` where it was."""
    import trimesh

    body, skin = scene.body, scene.skin
    mesh = trimesh.Trimesh(scale * body.mesh.vertices, body.mesh.faces, process=False)
    poses = skin.poses.copy()
    poses[:, :3, 3] *= scale
    shift = transform(np.eye(3), (1.0 - scale) * np.asarray(place))
    return scene.with_(
        body=replace(body, mesh=mesh, exact=None, told=None),
        skin=replace(skin, poses=poses),
        mount=scene.mount_pose @ shift,
    )
