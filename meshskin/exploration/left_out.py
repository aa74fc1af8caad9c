"""The taxels that a plan leaves out, the reason for each, and what would reach them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ..contact.reading import same_sheet
from ..core.arrays import Array
from ..robot import collision
from ..scene.scene import Scene
from ..skin.skin import Skin
from . import reach
from .path import ROWS, Path
from .pressing import lighter_helps
from .spacing import MAX_SPACING

ENOUGH = 4
"""Fewest contacts near a taxel for it to count as covered: one more than trilateration needs."""
NEAR, ASIDE = 0.9, 0.15
"""Distance within which a contact counts for a taxel, and least spread of the contacts about a line
for the taxel to be covered, both relative to the sensing radius."""

MANY = 0.1
"""Part of the taxels that are left out because the indenter is refused near them, from which the
plan recommends a lighter force or another radius."""
REFUSED = collision.HOLLOW, collision.EDGE, collision.SUPPORT, "does not hold"
"""Reasons, or parts of them, that another indenter may not have."""

NOT_COVERED = "no contact passes near it"
ONE_LINE = "contacts pass near it along one line only"
SPARSE = NOT_COVERED, ONE_LINE
"""Beginnings of the reasons that closer lanes remove."""
GIVEN_UP = "given up: "
"""Beginning of the reasons of taxels that the plan reaches and the run did not."""


Blocked = tuple[Array, Array]
"""Points (k, 3), body frame, and the reason (k,) why each cannot be touched, "" where it can."""


def too_wide(spacing: float, radius: float) -> str:
    """Advice for lanes whose spacing, m, is too large for the sensing radius, m; "" where it is
    not.
    """
    if spacing <= MAX_SPACING * radius:
        return ""
    apart, felt, least = (f"{1e3 * x:.2g} mm" for x in (spacing, radius, MAX_SPACING * radius))
    return f": lanes are {apart} apart, contacts felt within {felt}; bring lanes to {least}"


def still_left_out(
    skin: Skin, radius: float, segments: list[Path], blocked: list[Blocked], before: dict[int, str]
) -> dict[int, str]:
    """Taxels left out `before` that are still left out with more segments, whose contacts are
    felt at a smaller radius, m, too; and the reason of each."""
    now = taxels_left_out(skin, radius, segments, blocked)
    return {taxel: why for taxel, why in now.items() if taxel in before}


def served_lighter(skin: Skin, left_out: dict[int, str]) -> Array:
    """The positions (k, 3), m, of the taxels that were left out and that lighter contacts may
    serve."""
    helped = lighter_helps(list(left_out.values()))
    ids = np.array(list(left_out), dtype=int)[helped]
    return np.asarray(skin.positions[np.isin(skin.ids, ids)])


def other_contact(scene: Scene, left_out: dict[int, str]) -> str:
    """The force or indenter that is recommended where this one is refused near many taxels; ""
    elsewhere.
    """
    refused = sum(any(why in one for why in REFUSED) for one in left_out.values())
    if refused < MANY * len(scene.skin):
        return ""
    found = reach.other_contacts(scene)
    best = reach.recommended(found)
    if best is found[0]:
        return ""
    what = "a lighter force" if best.radius == found[0].radius else "another indenter"
    words = reach.recommendation(found)
    return f"use {what}: {words} (part of the taxels, without the limits of the arm)"


def without_parts(
    skin: Skin, radius: float, path: Path, parts: list[tuple[int, slice, str]]
) -> dict[int, str]:
    """The reason for each taxel, by id, that a path covers, and does not without some parts.

    parts: segment, its rows, and why they are left out. radius, m: as of `taxels_left_out`.
    """
    segments, blocked = path.segments, list[Blocked]()
    kept = [np.ones(len(segment.points), dtype=bool) for segment in segments]
    for place, rows, why in parts:
        kept[place][rows] = False
        points = segments[place].points[rows]
        blocked.append((points, np.full(len(points), why, dtype=object)))
    rest = [
        replace(segment, **{name: getattr(segment, name)[rows] for name in ROWS})
        for segment, rows in zip(segments, kept, strict=True)
        if rows.any()
    ]
    before = taxels_left_out(skin, radius, segments, [])
    now = taxels_left_out(skin, radius, rest, blocked)
    return {
        taxel: why
        for taxel, why in now.items()
        if taxel not in before and taxel not in path.unreachable
    }


def coverage(taxels: int, unreachable: Mapping[str, str]) -> dict[str, int]:
    """Of a number of taxels, how many a plan covers, a run covered, and the run gave up.

    A taxel that contacts pass along one line only has readings and is not covered.
    unreachable: the reason for each taxel that was not covered.
    """
    given_up = sum(why.startswith(GIVEN_UP) for why in unreachable.values())
    reached = taxels - len(unreachable)
    return {"planned": reached + given_up, "reached": reached, "given_up": given_up}


def taxels_left_out(
    skin: Skin, radius: float, segments: list[Path], blocked: list[Blocked]
) -> dict[int, str]:
    """The reason for each taxel, by id, that the segments do not cover on its own sheet of skin.

    It is the most frequent reason among the blocked points around the taxel. radius, m: distance at
    which a taxel feels a contact.
    """
    from scipy.spatial import cKDTree

    sites = skin.positions
    covered, sparse = np.zeros(len(sites), dtype=bool), np.full(len(sites), NOT_COVERED, object)
    if segments:
        points = np.concatenate([s.points for s in segments])
        length = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
        pitch = max(length / max(len(points) - 1, 1), 1e-9)
        rows = slice(None, None, max(int(0.1 * radius / pitch), 1))
        points, normals = points[rows], np.concatenate([s.normals for s in segments])[rows]
        for k, around in enumerate(cKDTree(points).query_ball_point(sites, NEAR * radius)):
            facing = np.broadcast_to(skin.normals[k], (len(around), 3))
            near = np.array(around, dtype=int)
            near = near[same_sheet(sites[k] - points[near], normals[near], facing)]
            if len(near) >= ENOUGH:
                offset = points[near] - points[near].mean(axis=0)
                spread = np.linalg.svd(offset, compute_uv=False) / np.sqrt(len(near))
                covered[k], sparse[k] = spread[1] > ASIDE * radius, ONE_LINE
    points = np.concatenate([np.zeros((0, 3)), *(points for points, _ in blocked)])
    reasons = np.concatenate([np.zeros(0, dtype=object), *(reason for _, reason in blocked)])
    points, reasons = points[reasons != ""], reasons[reasons != ""]
    tree = cKDTree(points) if len(points) else None
    out: dict[int, str] = {}
    for row in np.flatnonzero(~covered):
        around = tree.query_ball_point(sites[row], 1.5 * radius) if tree is not None else []
        counts = Counter(reasons[around] if around else ())
        out[int(skin.ids[row])] = counts.most_common(1)[0][0] if counts else sparse[row]
    return out
