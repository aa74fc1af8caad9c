"""Contacts that are made one by one: by an indenter that is carried to a body at rest, or by a body
that is set down on chosen points.

The contacts of a plan are on geodesic lanes over the skin, as far apart along a lane as the lanes
are. A hand reaches all of them. An arm reaches those to which it can bring the indenter within its
joint limits and without touching the body, at any rotation about the normal.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from ..core.arrays import Array
from ..core.errors import ReachError
from ..core.se3 import inverse, quaternion, transform
from ..geometry.geodesics import any_tangents, rotate_about
from ..geometry.surface.closest_point import Closest
from ..robot import collision, posture
from ..robot.contact_rig import ContactRig
from ..robot.turntable import with_swivel
from ..scene.scene import Scene
from .chains import evenly
from .lane_plan import STEP, posture_reasons, reachable_nodes, region_radius
from .lanes import cover
from .left_out import (
    NOT_COVERED,
    SPARSE,
    other_contact,
    served_lighter,
    still_left_out,
    taxels_left_out,
)
from .path import Path, Plan
from .pressing import lighter_note, lighter_rigs, pressed_lighter
from .spacing import check_spacing

CONTACTS = 8
"""Contacts per taxel that leave none of them with fewer than left_out.ENOUGH: on the paper's
sphere all have five or more; with six contacts some have fewer."""


def contact_plan(scene: Scene, rig: ContactRig) -> Plan:
    """The contacts on a scene's taxels by a carried indenter, ordered along a short tour.

    `Plan.contacts` has one row each: the contact point (px, py, pz), m, and outward normal (nx, ny,
    nz); the pose of the indenter at its force, its centre (x, y, z), m, and quaternion
    (qw, qx, qy, qz), z from the support to the sphere; the force, N; for an arm its joint angles
    (q1, ...), rad. All are in the body's frame. The plan's path has one row for each contact.
    Raises ReachError where no contact can be made.
    """
    exploration, sites = scene.exploration, scene.skin.positions
    spacing = exploration.lane_spacing
    if exploration.contacts is not None:  # as far apart along the lanes
        spacing = rig.sensing_radius * float(np.sqrt(np.pi / exploration.contacts))
    check_spacing(spacing, rig.sensing_radius)
    hit = _on_lanes(rig, sites, spacing, exploration.margin)
    reason = rig.contact_reasons(hit.point, hit.normal)
    segments, blocked = [], [(hit.point, reason)]
    segments += _pressed(scene, rig, hit, reason, reason == "", scene.law.force_reference)
    left_out = taxels_left_out(scene.skin, rig.sensing_radius, segments, blocked)
    for force, lighter in lighter_rigs(scene):
        served = served_lighter(scene.skin, left_out)
        if not len(served):
            break
        new = pressed_lighter(lighter, hit.point, hit.normal, reason, served)
        segments += _pressed(scene, lighter, hit, reason, new, force)
        left_out = still_left_out(scene.skin, lighter.sensing_radius, segments, blocked, left_out)
    other = other_contact(scene, left_out)
    if not segments:
        reasons = Counter(left_out.values()).most_common(1)
        raise ReachError(
            f"no contact can be made on the skin: {reasons[0][0] if reasons else NOT_COVERED}",
            value=f"{len(sites)} taxels",
            remedy=other or "place the arm nearer, or use another part of the body",
        )
    path = Path.concatenate(segments)
    path = replace(path, unreachable=left_out, breaks=tuple(range(1, len(path.points))))
    words = lighter_note(scene, path), other, _sparse(left_out, spacing)
    return Plan(path, spacing, tuple(filter(None, words)), _table(scene, path))


def _sparse(left_out: dict[int, str], spacing: float) -> str:
    """Advice for taxels with too few contacts near them, at a spacing, m, of the contacts; "" if
    there are none."""
    count = sum(why in SPARSE for why in left_out.values())
    if not count:
        return ""
    return (
        f"{count} taxels have too few contacts near them at a spacing of {1e3 * spacing:.3g} mm; "
        f"exploration.contacts = {CONTACTS} presses each about {CONTACTS} times"
    )


def _on_lanes(rig: ContactRig, sites: Array, spacing: float, margin: float) -> Closest:
    """Points on the surface `spacing`, m, apart along geodesic lanes and from lane to lane."""
    radius = region_radius(sites, margin, rig.sensing_radius)
    lanes = cover(rig.body, sites, spacing, radius, min(STEP, 0.8 * spacing))
    parts = [evenly(lane.point, spacing, 1) for lane in lanes]
    return rig.body.surface.nearest(np.concatenate(parts) if parts else sites)


def _pressed(
    scene: Scene, rig: ContactRig, hit: Closest, reason: Array, chosen: NDArray[np.bool_],
    force: float,
) -> list[Path]:  # fmt: skip
    """The path over those of the chosen (k,) contacts that can be made with a force, N; None if
    none can. The reasons (k,) of the others are filled in.
    """
    rows = np.flatnonzero(chosen)
    if not len(rows):
        return []
    rows = rows[nearest_neighbour_order(hit.point[rows])]
    path, reason[rows] = _path(scene, rig, hit.take(rows), force)
    count = len(path.points)
    return [replace(path, forces=np.full(count, force))] if count else []


def _path(scene: Scene, rig: ContactRig, hit: Closest, force: float) -> tuple[Path, Array]:
    """The path with one row, a segment of its own, for each contact that can be made with a force,
    N; and the reason (k,) why a contact cannot, "" where it can.
    """
    patches = scene.reading_model.patches(np.full(len(hit.point), force), hit.curvature)
    centres = hit.point + (scene.indenter.radius - patches.depth)[:, None] * hit.normal
    poses = rig.poses(centres, hit.normal, any_tangents(hit.normal))
    joints, reason = None, np.full(len(poses), "", dtype=object)
    if scene.indenter.carried_by == "arm" and len(poses):
        joints, poses, reason = _carried(scene, poses)
    rows = np.flatnonzero(reason == "")
    hit, breaks, twists = hit.take(rows), tuple(range(1, len(rows))), np.zeros((len(rows), 6))
    path = Path(scene.loop.dt, hit.point, hit.normal, poses[rows], twists, hit.face, breaks, joints)
    return path, reason


def _carried(scene: Scene, poses: Array) -> tuple[Array, Array, Array]:
    """Joint angles (k, n) of an arm that brings the indenter to k of the contacts; the poses (m, 4,
    4) at m contacts, turned about the normal as the arm holds the indenter; and the reason (m,) why
    it cannot be brought to a contact, "" where it can.

    The body rests in the world frame. poses: see `Path.poses`.
    """
    arm, mount = scene.arm, scene.mount_pose
    swivel = with_swivel(arm, mount)
    goal = inverse(poses) @ _indenter_pose(scene)
    tips = goal @ transform(mount[:3, :3].T, np.zeros(3))
    nodes = posture.solve_nodes(swivel, tips[:, None], anchor_spacing=1)
    collided = np.full(nodes.solved.shape, None, dtype=object)
    within = nodes.within_limits
    q = nodes.q[within][:, :-1]
    rest = np.repeat(np.eye(4)[None], len(q), axis=0)
    collided[within] = collision.arm_reasons(arm, scene.body, q, rest, None)
    reason = posture_reasons(arm, nodes, collided)
    rows = np.flatnonzero(reason == "")
    joints = posture.nearest_postures(nodes, collided == "", rows)[1][:, :-1]
    held = poses.copy()
    if len(rows):
        held[rows] = _indenter_pose(scene) @ inverse(arm.pose(joints) @ mount)
    return joints, held, reason


def _indenter_pose(scene: Scene) -> Array:
    """T_w_indenter (4, 4) of the poses in a path: that of a fixed indenter."""
    return transform(scene.indenter.rotation, np.array(scene.indenter.position))


def _table(scene: Scene, path: Path) -> pa.Table:
    """The list of contacts, see `contact_plan`."""
    pose = inverse(path.poses) @ _indenter_pose(scene)
    turn = quaternion(pose[:, :3, :3])[:, [3, 0, 1, 2]]
    columns: dict[tuple[str, ...], Array] = {
        ("px", "py", "pz"): path.points,
        ("nx", "ny", "nz"): path.normals,
        ("x", "y", "z"): pose[:, :3, 3],
        ("qw", "qx", "qy", "qz"): turn,
        ("force",): np.asarray(path.forces)[:, None],
    }
    if path.postures is not None:
        columns[tuple(f"q{k + 1}" for k in range(path.postures.shape[1]))] = path.postures
    return pa.table(
        {n: c for names, rows in columns.items() for n, c in zip(names, rows.T, strict=True)}
    )


def nearest_neighbour_order(points: Array) -> NDArray[np.intp]:
    """The order (k,) of points (k, 3), from the first, in which each next one is the nearest."""
    order = [0]
    remaining = np.ones(len(points), dtype=bool)
    remaining[0] = False
    while remaining.any():
        distance = np.linalg.norm(points - points[order[-1]], axis=1)
        order.append(int(np.argmin(np.where(remaining, distance, np.inf))))
        remaining[order[-1]] = False
    return np.array(order, dtype=np.intp)


def point_contacts(
    rig: ContactRig, points: Array, steps: int, dt: float
) -> tuple[list[Path], Array]:
    """A path at rest on each of the points (k, 3) that can be touched, in their order.

    Each path has `steps` rows of `dt` s. The second result is the reason (k,) why a point cannot be
    touched, "" where it can. Each posture is near the one before and far from the joint limits.
    """
    hit = rig.body.closest(points)
    reason = rig.contact_reasons(hit.point, hit.normal)
    rows = np.flatnonzero(reason == "")
    if not len(rows):
        return [], reason
    tangents = any_tangents(hit.normal[rows])
    if rig.arm is None:
        poses = rig.contact_poses(hit.point[rows], hit.normal[rows], tangents)
        postures = [None] * len(rows)
    else:
        nodes, usable, reason[rows] = reachable_nodes(
            rig, hit.point[rows], hit.normal[rows], tangents, anchor_spacing=1
        )
        found = np.flatnonzero(reason[rows] == "")
        spin, joints = posture.nearest_postures(nodes, usable, found)
        rows, normals = rows[found], hit.normal[rows[found]]
        headings = rotate_about(normals, tangents[found], spin)
        poses = rig.contact_poses(hit.point[rows], normals, headings)
        postures = list(joints[:, None])
    paths = [
        Path(
            dt=dt,
            points=np.repeat(hit.point[k : k + 1], steps, axis=0),
            normals=np.repeat(hit.normal[k : k + 1], steps, axis=0),
            poses=np.repeat(pose[None], steps, axis=0),
            twists=np.zeros((steps, 6)),
            faces=np.repeat(hit.face[k], steps),
            postures=q,
        )
        for k, pose, q in zip(rows, poses, postures, strict=True)
    ]
    return paths, reason
