"""Plan an exploration of any skin region: lanes, postures, breaks, and what cannot be reached."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ..core.errors import ReachError
from ..core.se3 import Array, inverse
from ..geometry.geodesics import rotate_about, transport_along
from ..robot import collision, posture
from ..robot.contact_rig import ContactRig
from ..scene.settings import Exploration
from .lanes import cover, runs, spacing_for
from .path import Path
from .timing import followed, free
from .tour import ContactPath, joined

STEP = 3e-3
"""Largest distance of samples along a lane, m."""
ENOUGH = 4
"""Contacts, apart from each other, of which a taxel is seen."""
WITHIN, ASIDE = 0.9, 0.15
"""How near the contacts must pass a taxel, and how far off a line, in distances of feeling."""
SHORT = 3
"""Samples below which a stretch of a lane is not worth a touch."""

FAR = "out of the arm's reach"
LIMIT = "joint limit"
WOUND = "joint limit: a joint winds up"
UNSEEN = "no contact passes near it"


@dataclass(frozen=True)
class Plan:
    """An exploration: places, each one touch long, and what they leave out."""

    path: Path
    """Over all places; between two the body is lifted off."""
    unreachable: Mapping[int, str]
    """Why each taxel (by id) that is not seen is not."""
    spacing: float
    """Distance between lanes, m."""
    notes: tuple[str, ...] = ()
    """What was taken for something simpler: links of the arm whose meshes could not be had, or that
    are part of the mount."""

    def __repr__(self) -> str:
        path, lost = self.path, len(self.unreachable)
        return (
            f"<Plan: {len(path.breaks) + 1} places, {path.dt * len(path.points):.4g} s of sliding, "
            f"lanes {1e3 * self.spacing:.4g} mm apart, {lost} taxels not seen>"
        )

    @property
    def segments(self) -> list[Path]:
        """The places in order, a path each."""
        return self.path.places

    @property
    def headings(self) -> Array:
        """R_w_b (k, 3, 3) along the path."""
        return self.path.poses[:, :3, :3]


def plan(
    setup: ContactRig,
    sites: Array,
    ids: NDArray[np.int64],
    exploration: Exploration,
    *,
    dt: float,
    frame: float,
) -> Plan:
    """The exploration of the taxels at `sites` (n, 3), body frame.

    dt: s, from step to step; frame: from reading to reading. Raises ReachError where
    nothing at all can be explored.
    """
    spacing = exploration.lane_spacing
    if exploration.contacts is not None:
        spacing = spacing_for(setup.reach, exploration.contacts, exploration.speed * frame)
    step = min(STEP, 0.8 * spacing)
    pieces = cover(setup.body, sites, spacing, keep(sites, exploration.margin), step)
    ways, blocked = [], []
    for piece in pieces:
        why = setup.fits(piece.points, piece.normals)
        blocked += list(zip(piece.points, why, strict=True))
        ways += [piece[run] for run in runs(why == "") if run.stop - run.start >= SHORT]
    strung = joined(setup, ways, spacing, step)
    if setup.arm is None:
        segments = [free(setup, way, exploration, dt) for way in strung]
    else:
        segments, lost = _carried(setup, strung, exploration, dt)
        blocked += lost
    missing = _unseen(setup, segments, sites, ids, blocked)
    if not segments:
        reasons = Counter(missing.values()).most_common(1)
        raise ReachError(
            f"nothing of the skin can be explored: {reasons[0][0] if reasons else UNSEEN}",
            value=f"{len(sites)} taxels, the indenter at "
            f"{tuple(round(float(x), 3) for x in setup.indenter.position)} m",
            remedy="move indenter.position_m, change the mount, or use a smaller indenter",
        )
    notes = collision.links(setup.arm).notes if setup.arm else ()
    notes += setup.mounted.notes if setup.mounted else ()
    return Plan(replace(Path.joined(segments), unreachable=missing), missing, spacing, notes)


def keep(sites: Array, margin: float) -> float:
    """How far from a taxel the region reaches, m: the margin, and over the gaps between taxels."""
    from scipy.spatial import cKDTree

    if len(sites) < 2:
        return margin
    nearest = cKDTree(sites).query(sites, 2)[0][:, 1]
    return max(margin, 0.75 * float(np.median(nearest)))


def _carried(
    setup: ContactRig, ways: list[ContactPath], exploration: Exploration, dt: float
) -> tuple[list[Path], list[tuple[Array, str]]]:
    """The paths over ways that the arm can follow, and samples (point, reason) that it cannot."""
    arm, spins = setup.arm, 2 * np.pi * np.arange(posture.SPINS) / posture.SPINS
    assert arm is not None
    assert setup.mount is not None
    if not ways:
        return [], []
    points, normals = (np.concatenate([getattr(w, k) for w in ways]) for k in ("points", "normals"))
    tangents = np.concatenate([transport_along(w.normals) for w in ways])
    starts = np.zeros(len(points), dtype=bool)
    firsts = np.cumsum([0, *(len(w) for w in ways)])
    starts[firsts[:-1]] = True
    headings = rotate_about(normals[:, None], tangents[:, None], spins)
    poses = setup.poses(setup.tips(points, normals)[:, None], normals[:, None], headings)
    found = posture.nodes(arm, poses @ inverse(setup.mount))
    usable, why = usable_nodes(setup, found, poses)
    lost = [(points[k], why[k]) for k in np.flatnonzero(why != "")]
    segments: list[Path] = []
    held = why == ""
    for run in runs(held):
        starts[run.start] = True
    if not held.any():
        return [], lost
    rows = np.flatnonzero(held)
    some = replace(
        found, q=found.q[rows], solved=found.solved[rows], spare=found.spare[rows],
        limit=found.limit[rows],
    )  # fmt: skip
    chosen = posture.choose(arm, some, usable[rows], starts[rows])
    cuts = [*np.flatnonzero(chosen.breaks), len(rows)]
    for first, last in pairwise(cuts):
        mine = rows[first:last]
        k = int(np.searchsorted(firsts, mine[0], side="right")) - 1
        way = ways[k].part(slice(mine[0] - firsts[k], mine[-1] + 1 - firsts[k]))
        angle = spins[0] + (spins[1] - spins[0]) * chosen.spin[first:last]
        q = chosen.q[first:last]
        parts = _parts(setup, way, tangents[mine], angle, q, exploration, dt)
        segments += parts
        if not parts:
            lost += [(point, WOUND) for point in way.points]
    return segments, lost


def _parts(
    setup: ContactRig, way: ContactPath, tangents: Array, angle: Array, q: Array,
    exploration: Exploration, dt: float,
) -> list[Path]:  # fmt: skip
    """The path over a way, halved where a joint that turns endlessly in the plan winds up."""
    if len(way) < SHORT:
        return []
    try:
        return [followed(setup, way, tangents, angle, q, exploration, dt)]
    except ReachError:
        middle = len(way) // 2
    halves = slice(0, middle), slice(middle, len(way))
    return [
        path
        for half in halves
        for path in _parts(
            setup, way.part(half), tangents[half], angle[half], q[half], exploration, dt
        )
    ]


def usable_nodes(
    setup: ContactRig, found: posture.Nodes, poses: Array
) -> tuple[NDArray[np.bool_], NDArray[np.object_]]:
    """The nodes (m, s, b) that may be taken, and why a sample (m,) has none ("" where it has)."""
    arm = setup.arm
    assert arm is not None
    usable = found.good.copy()
    m, s, b = np.nonzero(usable)
    q, held = found.q[m, s, b], setup.mounted
    hit = collision.arm_reasons(arm, setup.body, q, poses[m, s], setup.indenter, held)
    usable[m, s, b] = hit == ""
    why = np.full(len(usable), "", dtype=object)
    for k in np.flatnonzero(~usable.any(axis=(1, 2))):
        if not found.solved[k].any():
            why[k] = FAR
        elif not found.good[k].any():
            best = np.unravel_index(np.argmax(found.spare[k]), found.spare[k].shape)
            why[k] = f"{LIMIT} of {arm.joint_names[found.limit[k][best]]}"
        else:
            why[k] = Counter(hit[m == k]).most_common(1)[0][0]
    return usable, why


def _unseen(
    setup: ContactRig,
    segments: list[Path],
    sites: Array,
    ids: NDArray[np.int64],
    blocked: list[tuple[Array, str]],
) -> dict[int, str]:
    """Why each taxel that the segments do not see is not seen, by id."""
    from scipy.spatial import cKDTree

    seen = np.zeros(len(sites), dtype=bool)
    if segments:
        points = np.concatenate([s.points for s in segments])
        fine = max(float(np.linalg.norm(np.diff(points, axis=0), axis=1).mean()), 1e-9)
        points = points[:: max(int(0.1 * setup.reach / fine), 1)]
        for k, near in enumerate(cKDTree(points).query_ball_point(sites, WITHIN * setup.reach)):
            if len(near) >= ENOUGH:
                offset = points[near] - points[near].mean(axis=0)
                spread = np.linalg.svd(offset, compute_uv=False) / np.sqrt(len(near))
                seen[k] = spread[1] > ASIDE * setup.reach
    reasons = [(point, why) for point, why in blocked if why]
    out: dict[int, str] = {}
    tree = cKDTree(np.array([point for point, _ in reasons])) if reasons else None
    for row in np.flatnonzero(~seen):
        around = tree.query_ball_point(sites[row], 1.5 * setup.reach) if tree is not None else []
        counts = Counter(reasons[j][1] for j in around)
        out[int(ids[row])] = counts.most_common(1)[0][0] if counts else UNSEEN
    return out
