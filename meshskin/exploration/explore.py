"""Where to touch: the exploration of a scene, and of any skin region, planned for the arm.

Caps of spheres are explored by the paper's parallels about the skin's axis, as far as the arm can
turn them; everything else by geodesic lanes (motion/plan.py).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from .. import contact as models
from ..contact import Patch
from ..contact.indenter import Indenter
from ..contact.material import Material
from ..core.arguments import check_real, check_type, repr_short
from ..core.errors import ConfigError, ReachError, SkinError
from ..core.se3 import (
    Array,
    interpolate,
    inverse,
    is_rigid,
    log_so3,
    orthonormal_basis,
    perpendicular,
)
from ..geometry.body import Body
from ..geometry.region import Region
from ..robot.arm import Arm
from ..robot.contact_rig import ContactRig
from ..scene.scene import Scene
from ..scene.settings import Exploration
from ..skin.skin import Skin
from . import path as paths
from . import plan as plans

HEADINGS = 8
"""Directions about the indenter's tried for the skin's first meridian."""
CHECKS = 400
"""Samples of the path whose joint angles are solved for each heading."""
ROUND = 0.02
"""Relative scatter of the curvatures up to which a body counts as a sphere."""
ROUNDER = 0.9
"""Curvature of a hollow, in parts of the indenter's, up to which the indenter fits."""
CONTACTS = 70.0
"""Contacts of each taxel where nothing else is wanted: lanes 3.5 mm apart on the paper's sphere."""
SITE_SPACING = 5e-3
"""Distance of the places that stand for a region given without taxels, m."""
FOLLOWED = 0.05
"""Turns from pose to pose over which inverse kinematics goes on with the posture, rad."""


def explore(
    body: Body,
    skin_region: Skin | Region | str,
    *,
    arm: Arm | None = None,
    mount: Array | None = None,
    indenter: Indenter | None = None,
    material: Material | None = None,
    force: float = 3.0,
    exploration: Exploration | None = None,
    dt: float = 1e-3,
    frame: float = 0.01,
) -> plans.Plan:
    """Plan how the contact point passes over a skin, or over a region of a body.

    Geodesic lanes, spun about the normal as the joints' limits ask, broken where the arm must take
    another posture. arm: None for a body that moves freely; mount: T_tip_body (4, 4), which an arm
    needs. force, N, and material: of the contact, whose patch sets the depth and, with
    `exploration.contacts`, the spacing of the lanes. dt, s: of the path; frame, s: between
    readings. A region (a patch by its name, or another part of the surface) is taken as places
    5 mm apart, numbered. Raises ReachError where nothing can be explored, SkinError for a region
    too small, ContactError where no contact model holds, ConfigError for numbers that cannot be.
    """
    for name, value, unit in (("force", force, "N"), ("dt", dt, "s"), ("frame", frame, "s")):
        check_real(f"{name} of an exploration", value, unit, above=0.0)
    check_type(Body, body, "what is explored")
    if arm is not None:
        check_type(Arm, arm, "the arm of an exploration")
    skin = skin_region
    if not isinstance(skin, Skin):
        skin = Skin.cover(body, spacing=SITE_SPACING, region=skin)
    if arm is not None and mount is None:
        raise SkinError("an arm without a mount", remedy="give mount=, T_tip_body (4, 4)")
    if mount is not None and not is_rigid(mount):
        raise ConfigError(
            "the mount is no rigid transform",
            value=repr_short(mount),
            limit="a finite (4, 4) with a rotation in it",
        )
    indenter, material = indenter or Indenter(), material or Material()
    patch = models.solve(
        "hertz",
        force=force,
        curvature=_typical(body.closest(skin.positions).curvature, indenter),
        indenter_radius=indenter.radius,
        modulus=material.young,
        poisson=material.poisson,
        thickness=material.thickness,
        upgrade=True,
    )
    setup = _setup(body, indenter, patch, skin.disc_radius, arm, mount)
    wanted = exploration or Exploration(pattern="lanes", contacts=CONTACTS)
    return plans.plan(setup, skin.positions, skin.ids, wanted, dt=dt, frame=frame)


def _typical(curvature: Array, indenter: Indenter) -> tuple[float, float]:
    """The principal curvatures, 1/m, among (k, 2), of a place in the middle of those that the
    indenter fits: what is too hollow for it is left out by the plan.
    """
    fitting = curvature[curvature[:, 1] * indenter.radius > -ROUNDER]
    curvature = fitting if len(fitting) else curvature
    mean = curvature.mean(axis=1)
    first, second = curvature[np.argmin(np.abs(mean - np.median(mean)))]
    return first, second


def _setup(
    body: Body,
    indenter: Indenter,
    patch: Patch,
    disc_radius: float,
    arm: Arm | None,
    mount: Array | None,
    holds: Callable[[Array], Array] | None = None,
) -> ContactRig:
    """What explores, by the patch of a usual contact; holds: as in Setup."""
    least, most = float(patch.semi_axes[-1]), float(patch.semi_axes[0])
    return ContactRig(body, indenter, patch.depth, least + disc_radius, arm, mount, most, holds)


def setup_of(scene: Scene) -> ContactRig:
    """What explores in a scene."""
    return _setup(
        scene.body,
        scene.indenter,
        scene.patch,
        scene.skin.disc_radius,
        scene.arm if scene.loop.mode == "arm" else None,
        scene.mount_pose,
        scene.invalid_reasons,
    )


def planned(scene: Scene) -> plans.Plan:
    """The scene's exploration in geodesic lanes. Raises ReachError."""
    setup = setup_of(scene)
    frame = scene.frame_steps * scene.loop.dt
    skin = scene.skin
    return plans.plan(
        setup, skin.positions, skin.ids, scene.exploration, dt=scene.loop.dt, frame=frame
    )


def route(scene: Scene) -> tuple[paths.Path, Array]:
    """The path of the scene's exploration by its pattern, and where it starts.

    The start: joint angles (n,) at the standoff over the first pose, or, without an arm, that pose
    (4, 4). Raises ReachError if the arm cannot follow the path; with "auto", where it cannot follow
    parallels it takes lanes, which it may leave for another posture.
    """
    pattern = scene.exploration.pattern
    if pattern == "parallels" or (pattern == "auto" and is_cap(scene)):
        scene.check_contact(scene.body.closest(scene.skin.positions).curvature)
        if scene.loop.mode != "arm":
            path = parallels(scene, 0.0, scene.loop.dt)
            return path, start_of(scene, path)
        try:
            return reachable_path(scene, scene.arm)
        except ReachError:
            if pattern == "parallels":
                raise
    path = planned(scene).path
    return path, start_of(scene, path)


def start_of(scene: Scene, path: paths.Path) -> Array:
    """Where a path is begun, at the standoff over its first pose: as `route`."""
    first, tip_body = path.poses[0], inverse(scene.mount_pose)
    if path.postures is None:
        return above(scene, first)
    way = _bridge(first, above(scene, first)) @ tip_body
    return np.asarray(scene.arm.inverse_kinematics(way, path.postures[0])[-1])


def is_cap(scene: Scene) -> bool:
    """Whether the skin lies on a sphere: convex, and all its curvatures the same."""
    curvature = scene.body.closest(scene.skin.positions).curvature
    mean = float(curvature.mean())
    return bool(mean > 0 and np.abs(curvature - mean).max() < ROUND * mean)


def above(scene: Scene, pose: Array) -> Array:
    """A pose at the reference depth, lifted to the standoff."""
    above = pose.copy()
    above[:3, 3] += (scene.exploration.standoff + scene.patch.depth) * scene.indenter.axis
    return above


def reachable_path(scene: Scene, arm: Arm) -> tuple[paths.Path, Array]:
    """The exploration path and the joint angles (n,) at its standoff, with the best heading.

    Of the headings about the indenter, the one that stays farthest from the joint limits is taken.
    Raises ReachError with the best heading's reason if none works.
    """
    best: tuple[float, paths.Path, Array] | None = None
    reason: ReachError | None = None
    tip_body = inverse(scene.mount_pose)
    for heading in np.arange(HEADINGS) * 2 * np.pi / HEADINGS:
        coarse = parallels(scene, heading, scene.loop.dt * 50)
        rows = slice(None, None, max(len(coarse.poses) // CHECKS, 1))
        poses = coarse.poses[rows] @ tip_body
        middle = _middle(coarse.normals[rows], scene.axis)
        try:
            # back along the path itself: half a turn straight to its start has two ways round
            first = arm.inverse_kinematics(poses[middle::-1], arm.solve(poses[middle]))[-1]
            q = arm.inverse_kinematics(poses, first)
            start = arm.inverse_kinematics(
                above(scene, poses[0] @ inverse(tip_body))[None] @ tip_body, first
            )[0]
        except ReachError as error:
            reason = reason or error
            continue
        spare = float(np.minimum(q - arm.lower, arm.upper - q).min())
        if best is None or spare > best[0]:
            best = spare, coarse, start
            best_heading = heading
    if best is None:
        raise ReachError(
            f"the arm {arm.name} cannot turn the skin over the indenter at "
            f"{tuple(round(float(x), 3) for x in scene.indenter.position)} m: {reason}",
            remedy="move indenter.position_m, change the mount, or take exploration.pattern lanes",
        ) from reason
    return parallels(scene, best_heading, scene.loop.dt), best[2]


def _middle(normals: Array, axis: Array) -> int:
    """The sample, of normals (k, 3) along parallels, whose turn about the axis is in the middle of
    all turns, and that is about halfway: there the last joint has as far to go either way.
    """
    e1, e2, _ = orthonormal_basis(axis, perpendicular(axis)).T
    turn, count = np.abs(np.arctan2(normals @ e2, normals @ e1)), len(normals)
    return int(np.argmin(turn + np.abs(np.arange(count) / count - 0.5)))


def parallels(scene: Scene, heading: float, dt: float) -> paths.Path:
    """The paper's path, its first meridian at an angle about the indenter's direction, rad."""
    cosine = np.clip(scene.skin.normals @ scene.axis, -1.0, 1.0)
    return paths.plan(
        scene.body,
        scene.axis,
        float(np.arccos(cosine.min())),
        scene.exploration,
        indenter=scene.indenter,
        gap=scene.indenter.radius - scene.patch.depth,
        heading=heading,
        dt=dt,
    )


def _bridge(start: Array, goal: Array) -> Array:
    """Poses (k, 4, 4) from one to the other, each turned by at most FOLLOWED to the next."""
    angle = np.linalg.norm(log_so3(goal[:3, :3] @ start[:3, :3].T))
    return interpolate(start, goal, np.linspace(0.0, 1.0, 2 + int(np.ceil(angle / FOLLOWED))))
