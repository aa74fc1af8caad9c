"""Plans over geodesic lanes: segments, postures, and reasons for the taxels that are left out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import Array, Index, median_spacing, ranges, runs
from ..core.errors import ReachError
from ..core.progress import Progress, Stage
from ..core.se3 import inverse
from ..geometry.geodesics import transport_along
from ..geometry.surface.closest_point import Closest
from ..robot import collision, posture
from ..robot.arm import Arm
from ..robot.contact_rig import ContactRig
from ..scene.scene import Scene
from .lanes import cover
from .left_out import (
    NOT_COVERED,
    SPARSE,
    Blocked,
    other_contact,
    served_lighter,
    still_left_out,
    taxels_left_out,
    too_wide,
)
from .path import Path, Plan
from .pressing import grown_runs, lighter_helps, lighter_note, lighter_rigs, pressed_lighter
from .spacing import check_spacing, spacing_for
from .tour import SHORT, ContactPath, Parts, arm_paths, contact_paths, free_paths

STEP = 3e-3
"""Largest distance of samples along a lane, m: about half the distance of neighbouring taxels."""
NODE_STEP, NODE_TURN = 6e-3, 0.1
"""Largest distance, m, and turn of the normal, rad, between samples at which postures are sought.
The arm is followed over the samples between them."""
NEIGHBOURS = 2 * NODE_STEP
"""Distance of two samples, m, from which postures are not followed from one to the other."""

OUT_OF_REACH = "out of the arm's reach"
LIMIT = "joint limit"
WINDING = "joint limit: a joint winds up"


def lane_plan(scene: Scene, rig: ContactRig, progress: Progress | None = None) -> Plan:
    """The exploration of a scene's taxels by geodesic lanes, with its contact rig.

    progress("explore", done, total): called between the steps of the planning. Raises
    ReachError where nothing can be explored.
    """
    stage = Stage(progress, "explore", 4)
    exploration = scene.exploration
    sites, spacing = scene.skin.positions, exploration.lane_spacing
    if exploration.contacts is not None:
        pitch = exploration.speed * (scene.frame_steps * scene.loop.dt)
        spacing = spacing_for(rig.sensing_radius, exploration.contacts, pitch)
    check_spacing(spacing, rig.sensing_radius)
    step = min(STEP, 0.8 * spacing)
    radius = region_radius(sites, exploration.margin, rig.sensing_radius)
    lanes = cover(rig.body, sites, spacing, radius, step)
    stage.step()
    pieces, blocked = _feasible(rig, lanes)
    stage.step()
    paths = contact_paths(rig, pieces, spacing, step)
    stage.step()
    segments, unreached = _segments(scene, rig, paths)
    blocked += unreached
    stage.step()
    left_out = taxels_left_out(scene.skin, rig.sensing_radius, segments, blocked)
    left_out, forces = _press_lighter(scene, segments, blocked, lanes, left_out, spacing, step)
    wide = too_wide(spacing, rig.sensing_radius)
    left_out = {k: why + wide if why in SPARSE else why for k, why in left_out.items()}
    other = other_contact(scene, left_out)
    if not segments:
        why = (Counter(left_out.values()).most_common(1) or [(NOT_COVERED + wide, 0)])[0][0]
        raise ReachError(
            f"nothing of the skin can be explored: {why}",
            value=f"{len(sites)} taxels, the indenter at "
            f"{tuple(round(float(x), 3) for x in rig.indenter.position)} m",
            remedy=_remedy(why, other, wide),
        )
    notes = collision.arm_capsules(rig.arm).notes if rig.arm else ()
    notes += rig.allowed_collisions.notes if rig.allowed_collisions else ()
    path = replace(Path.concatenate(segments), unreachable=left_out, forces=forces)
    return Plan(path, spacing, (*notes, *filter(None, (lighter_note(scene, path), other))))


def _remedy(why: str, other: str, wide: str) -> str:
    """Advice where nothing can be explored because of `why`.

    The place of the indenter or the body where the arm is the reason; elsewhere the recommended
    contact, `other`, if there is one. Reasons that end in `wide` name a remedy themselves.
    """
    arms = OUT_OF_REACH, LIMIT, collision.ARM_SUPPORT, collision.ARM_BODY
    if why.startswith(arms):
        return (
            "move indenter.position_m, change the mount, or let the indenter be carried to the "
            "body (indenter.carried_by)"
        )
    named = wide and why.endswith(wide)
    return other or ("" if named else "change the indenter, or the part of the body with the skin")


def _feasible(rig: ContactRig, lanes: list[Closest]) -> tuple[list[Closest], list[Blocked]]:
    """The parts of lanes along which the indenter can be pressed in; why it cannot elsewhere."""
    if not lanes:
        return [], []
    whole = Closest.concatenate(lanes)
    reason = rig.contact_reasons(whole.point, whole.normal)
    parts = np.split(reason, np.cumsum([len(piece.point) for piece in lanes])[:-1])
    pieces = [
        piece.take(run)
        for piece, part in zip(lanes, parts, strict=True)
        for run in runs(part == "")
        if run.stop - run.start >= SHORT
    ]
    return pieces, [(whole.point, reason)]


def region_radius(sites: Array, margin: float, sensing_radius: float) -> float:
    """Distance from a taxel, m, within which the surface is explored.

    The margin, but at least 0.75 of the taxels' pitch, so that the region has no gaps; of taxels
    farther apart 1.5 sensing radii: beyond one no taxel feels a contact, and the rest keeps pieces
    of lanes long enough next to places where the indenter does not fit.
    """
    if len(sites) < 2:
        return max(margin, 1.5 * sensing_radius)
    return max(margin, min(0.75 * median_spacing(sites), 1.5 * sensing_radius))


def _segments(scene: Scene, rig: ContactRig, paths: list[ContactPath]) -> Parts:
    """The segments along contact paths, and what cannot be reached."""
    if rig.arm is not None:
        return _arm_segments(scene, rig, paths)
    return _joined(free_paths(scene, rig, path) for path in paths)


def _joined(parts: Iterable[Parts]) -> Parts:
    """The segments of all parts, and what cannot be reached in any."""
    segments, blocked = list[Path](), list[Blocked]()
    for more, others in parts:
        segments, blocked = segments + more, blocked + others
    return segments, blocked


def _press_lighter(
    scene: Scene, segments: list[Path], blocked: list[Blocked], lanes: list[Closest],
    left_out: dict[int, str], spacing: float, step: float,
) -> tuple[dict[int, str], Array | None]:  # fmt: skip
    """Add segments with lighter contacts where these serve taxels that are left out.

    `blocked` begins with the samples of the lanes, whose reasons are replaced. The taxels that are
    still left out, with what keeps lighter contacts from them, and the forces (k,), N, of all
    segments; None: all of them that of the law.
    """
    forces, obstacles = [float(scene.law.force_reference)] * len(segments), dict[int, str]()
    if not lighter_helps(list(left_out.values())).any():
        return left_out, None
    whole, reason = Closest.concatenate(lanes), blocked[0][1]
    ends = np.cumsum([len(piece.point) for piece in lanes])[:-1]
    for force, rig in lighter_rigs(scene):
        sites = served_lighter(scene.skin, left_out)
        if not len(sites):
            break
        before = reason.copy()
        new = pressed_lighter(rig, whole.point, whole.normal, reason, sites)
        parts = zip(lanes, np.split(new, ends), np.split(reason == "", ends), strict=True)
        pieces = [
            piece.take(run) for piece, at, free in parts for run in grown_runs(at, free, SHORT)
        ]
        paths = contact_paths(rig, pieces, spacing, step)
        made, unreached = _segments(scene, rig, paths)
        more = [*segments, *made], [*blocked, *unreached]
        still = still_left_out(scene.skin, rig.sensing_radius, *more, left_out)
        if len(still) < len(left_out):
            left_out, forces = still, forces + [force] * len(made)
            segments[:], blocked[:] = more
        else:  # a still lighter contact may have room where this one found too little
            reason[:] = before
            obstacles |= {taxel: why for taxel, why in still.items() if why not in SPARSE}
    return {k: obstacles.get(k, why) for k, why in left_out.items()}, np.array(forces)


def _arm_segments(
    scene: Scene, rig: ContactRig, paths: list[ContactPath]
) -> tuple[list[Path], list[Blocked]]:
    """The segments along contact paths that the arm can follow, and what it cannot reach."""
    arm = rig.arm
    assert arm is not None
    if not paths:
        return [], []
    points = np.concatenate([p.points for p in paths])
    normals = np.concatenate([p.normals for p in paths])
    tangents = np.concatenate([transport_along(p.normals) for p in paths])
    first = np.cumsum([0, *(len(p) for p in paths)])
    at, nodes, usable, reason = _sparse_nodes(rig, points, normals, tangents, first[:-1])
    blocked: list[Blocked] = [(points[at], reason)]
    rows = np.flatnonzero(reason == "")
    if not len(rows):
        return [], blocked
    begins = [*np.searchsorted(at, first[:-1]), *(run.start for run in runs(reason == ""))]
    chain = posture.cheapest_chain(arm, nodes.take(rows), usable[rows], np.isin(rows, begins))
    segments: list[Path] = []
    for begin, end in pairwise([*np.flatnonzero(chain.breaks), len(rows)]):
        known = at[rows[begin:end]]
        own = np.arange(known[0], known[-1] + 1)
        k = int(np.searchsorted(first, own[0], side="right")) - 1
        path = paths[k].part(slice(own[0] - first[k], own[-1] + 1 - first[k]))
        spin = np.interp(own, known, chain.spin[begin:end])
        q = chain.q[begin + np.searchsorted(known, own, side="right") - 1]
        parts, unreached = _split(scene, rig, path, tangents[own], spin, q)
        segments, blocked = segments + parts, blocked + unreached
        if not parts and not unreached:
            blocked.append((path.points, np.full(len(path), WINDING, dtype=object)))
    return segments, blocked


def _split(
    scene: Scene, rig: ContactRig, path: ContactPath, tangents: Array, spin: Array, q: Array
) -> Parts:
    """The segments along a contact path, in halves where an endless joint of the chain winds up."""
    if len(path) < SHORT:
        return [], []
    try:
        return arm_paths(scene, rig, path, tangents, spin, q[0])
    except ReachError:
        middle = len(path) // 2
    halves = slice(0, middle), slice(middle, len(path))
    return _joined(_split(scene, rig, path.part(h), tangents[h], spin[h], q[h]) for h in halves)


def _sparse_nodes(
    rig: ContactRig, points: Array, normals: Array, tangents: Array, first: Index
) -> tuple[Index, posture.Nodes, NDArray[np.bool_], Array]:
    """Some of the samples (m, 3) of all contact paths, in order, and what `reachable_nodes` finds
    there: NODE_STEP apart, but all samples between one that is reached and one that is not.

    first (p,): the first sample of each path.
    """

    def solved(rows: Index) -> tuple[posture.Nodes, NDArray[np.bool_], Array]:
        gap = np.linalg.norm(np.diff(points[rows], axis=0, prepend=np.inf), axis=1)
        starts = np.isin(rows, first) | (gap > NEIGHBOURS)
        return reachable_nodes(rig, points[rows], normals[rows], tangents[rows], starts=starts)

    rows = _sparse(points, normals, first)
    nodes, usable, reason = solved(rows)
    change = np.flatnonzero((reason[1:] == "") != (reason[:-1] == ""))
    between = ranges(rows[change] + 1, rows[change + 1] - rows[change] - 1)
    if not len(between):
        return rows, nodes, usable, reason
    others, more, why = solved(between)
    width = max(usable.shape[2], more.shape[2])
    usable = np.concatenate([posture.widened(x, width, False) for x in (usable, more)])
    rows, reason = np.concatenate([rows, between]), np.concatenate([reason, why])
    order = np.argsort(rows)
    return rows[order], nodes.joined(others).take(order), usable[order], reason[order]


def _sparse(points: Array, normals: Array, first: Index) -> Index:
    """Rows of samples (m, 3): both ends of each path, and as few between as the limits allow.

    first (p,): the first sample of each path; a path keeps samples at most NODE_STEP, m, along it
    and NODE_TURN, rad, apart, but never fewer than every one.
    """
    step = np.linalg.norm(np.diff(points, axis=0), axis=1) / NODE_STEP
    turn = np.linalg.norm(np.diff(normals, axis=0), axis=1) / NODE_TURN
    begin, kept, gone = set(first.tolist()), [], 0.0
    for k, way in enumerate(np.append(np.maximum(step, turn), np.inf).tolist()):
        if k in begin or k + 1 in begin or gone + way > 1.0:
            kept.append(k)
            gone = 0.0
        gone += way
    return np.array(kept)


def reachable_nodes(
    rig: ContactRig,
    points: Array,
    normals: Array,
    tangents: Array,
    anchor_spacing: int = posture.ANCHOR_SPACING,
    starts: NDArray[np.bool_] | None = None,
) -> tuple[posture.Nodes, NDArray[np.bool_], Array]:
    """Postures over all spins at contact points (m, 3), which of them (m, s, b) are free of
    collisions, and the reason (m,) where none is ("" elsewhere).

    tangents (m, 3): headings at spin 0; anchor_spacing, starts: as in `posture.solve_nodes`.
    """
    arm = rig.arm
    assert arm is not None
    poses = rig.spin_poses(points, normals, tangents)
    nodes = posture.solve_nodes(arm, poses @ inverse(rig.mount), anchor_spacing, starts)
    collided = _collisions(rig, nodes)
    missing = np.flatnonzero(~(collided == "").any(axis=(1, 2)))
    if len(missing):  # at no spin of the grid
        at = points[missing], normals[missing], tangents[missing]
        apart = np.diff(missing, prepend=-1) > 1
        alone = apart if starts is None else apart | starts[missing]
        solved = rig.solved_spins(*at, anchor_spacing, alone)
        met = _collisions(rig, solved)
        better = (met == "").any(axis=(1, 2))
        better |= solved.solved.any(axis=(1, 2)) & ~nodes.solved[missing].any(axis=(1, 2))
        nodes = nodes.replaced(missing[better], solved.take(np.flatnonzero(better)))
        collided, met = (posture.widened(x, nodes.q.shape[2], None) for x in (collided, met))
        collided[missing[better]] = met[better]
    return nodes, np.asarray(collided == ""), posture_reasons(arm, nodes, collided)


def posture_reasons(arm: Arm, nodes: posture.Nodes, collided: Array) -> Array:
    """The reason (m,) why none of a sample's postures can be taken, "" where one can.

    collided (m, s, b): why each posture collides, "" where it does not; None beyond the limits.
    """
    reason = np.full(len(collided), "", dtype=object)
    for k in np.flatnonzero(~(collided == "").any(axis=(1, 2))):
        if not nodes.solved[k].any():
            reason[k] = OUT_OF_REACH
        elif not nodes.within_limits[k].any():
            best = np.unravel_index(np.argmax(nodes.margin[k]), nodes.margin[k].shape)
            reason[k] = f"{LIMIT} of {arm.joint_names[nodes.joint[k][best]]}"
        else:
            reason[k] = Counter(collided[k][nodes.within_limits[k]]).most_common(1)[0][0]
    return reason


def _collisions(rig: ContactRig, nodes: posture.Nodes) -> Array:
    """Why each posture (m, s, b) collides, "" where it does not; None beyond the joint limits."""
    arm, within = rig.arm, nodes.within_limits
    assert arm is not None
    out = np.full(within.shape, None, dtype=object)
    q = nodes.q[within]
    if len(q):
        poses = arm.pose(q) @ rig.mount
        out[within] = collision.arm_reasons(
            arm, rig.body, q, poses, rig.indenter, rig.allowed_collisions
        )
    return out
