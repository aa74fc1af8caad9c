"""Collisions while a body is pressed on its indenter.

The indenter is the tip of a thin column, its support. The indenter must touch the surface in one
point only, and the support must not meet the body or the arm; the arm's links must not meet the
body. A link is represented by capsules about its shapes (link_shapes.py), or by one of radius
`LINK_RADIUS` from joint to joint where the URDF has no shape or its mesh is missing. Against the
body a capsule is represented by overlapping spheres, as the signed distance of the surface is
known for points. Spheres of links that are fixed to the tip, or that are in the body in every
posture, belong to the mount and are not checked; nor are those of a link that meets the body in
every posture, within `WRIST_RADIUS` of the tip.

coal (3.0.3) was weighed: it takes 7 to 47 us per link and posture from Python against 6 us here,
has no batched query, no curved surface and no wheel for Windows; it is the oracle of the tests. An
R-tree would have nothing to sort, as all links are tested against one body.

Source of the mount: Coleman, Sucan, Chitta, Correll, "Reducing the barrier to entry of complex
robotic software: a MoveIt! case study" (Journal of Software Engineering for Robotics 5(1), 2014),
whose setup disables the collisions of pairs of links that meet in all of some random postures.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from itertools import takewhile

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..contact.indenter import Indenter
from ..core.arrays import Array, ranges
from ..core.many_points import RowFunction
from ..geometry.body import Body
from ..geometry.surface.distance_grid import DistanceGrid
from ..geometry.surface.surface import Surface
from . import link_shapes
from .arm import Arm

LINK_RADIUS = 0.03
"""Radius of a link without a shape, m. Chosen: slimmer than the links of the arms in the tests, so
that a guess does not forbid what the arm can do."""
WRIST_RADIUS = 0.12
"""Distance from the tip, m, within which a link that meets the body in every posture belongs to the
mount, so that an overestimated link does not forbid all bent wrists. Chosen: a wrist's length."""
RANDOM_POSTURES = 200
"""Random postures in which the arm is tested for what meets the body in all of them: what is free
in 2 % of the postures is found with a probability of 98 %."""
BATCH = 4096
"""Postures tested together, which bounds the memory."""
CONTACT_SLACK = 1e-3
"""Relative tolerance of the test that a sphere touches at one point only."""
ROUGHNESS = 0.05
"""Overlap, in depths of the contact, up to which the surface within its patch counts as touched at
one point: it moves the contact point by a third of the patch at most. On a skinned link, meshed
every millimetre, ripples of 10 to 40 um are within the patch of 6 % of the points, of a depth of
1.3 mm."""
TRACING_SLACK = 0.05
"""Part of the support's radius that is kept clear when its axis is traced: distances to a smooth
surface over coarse facets change by slightly more than the distance moved."""
PITCH_ERROR = 1.12
"""Radius that samples of the support have, relative to its own: samples one radius apart leave
sqrt(1 + 1/4) of it between them."""

HOLLOW = "concave: the indenter does not fit"
EDGE = "edge: the contact patch would run over it"
SUPPORT = "collision: the indenter's support meets the body"
ENCLOSED = "enclosed: no straight path of the indenter from outside was found"
ARM_SUPPORT = "collision: the arm meets the indenter's support"
ARM_BODY = "collision: the arm meets the body"


def contact_reasons(
    body: Body, points: Array, normals: Array, indenter: Indenter, depth: float
) -> Array:
    """Reason (k,) why the indenter cannot be pressed in at points (k, 3); "" where it can.

    normals (k, 3): outward, along the support's axis. A sphere larger than the indenter by the
    depth, m, must touch the body at the point and nowhere else.
    """
    reason = np.full(len(points), "", dtype=object)
    if not len(points):
        return reason
    large = indenter.radius + depth
    hit = body.closest(points + large * normals)
    # within the patch the surface is pressed anyway: there it may be as rough as a model is exact
    inside = np.linalg.norm(hit.point - points, axis=1) < np.sqrt(indenter.radius * depth)
    slack = np.maximum(CONTACT_SLACK * large, np.where(inside, ROUGHNESS * depth, 0.0))
    hollow = large - hit.distance > slack
    reason[hollow] = HOLLOW
    free = np.flatnonzero(~hollow)
    reason[free[_support_meets(body, points[free], normals[free], indenter)]] = SUPPORT
    return reason


def _support_meets(
    body: Body, points: Array, normals: Array, indenter: Indenter
) -> NDArray[np.bool_]:
    """Whether (k,) the support behind contact points (k, 3) meets the body.

    The samples of its axis are tested from the sphere on; as far from one as it is clear of the
    body, the next ones are clear, too. Source: Hart, "Sphere tracing", Visual Computer 12 (1996).
    """
    heights, least = support_samples(indenter), PITCH_ERROR * indenter.column_radius
    meets = np.zeros(len(points), dtype=bool)
    row, sample = np.arange(len(points)), np.zeros(len(points), dtype=np.intp)
    while len(row):
        at = points[row] + heights[sample, None] * normals[row]
        gap = body.closest(at).distance - least
        meets[row[gap < 0.0]] = True
        clear = heights[sample] + np.maximum(gap - TRACING_SLACK * least, 0.0)
        sample = np.maximum(np.searchsorted(heights, clear, side="right"), sample + 1)
        going = (gap >= 0.0) & (sample < len(heights))
        row, sample = row[going], sample[going]
    return meets


def edge_points(body: Body, spacing: float) -> Array:
    """Points (k, 3), body frame, at most `spacing`, m, apart on the body's edges and borders."""
    ends = body.surface.edges
    count = np.ceil(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) / spacing).astype(int) + 1
    row = np.repeat(np.arange(len(count)), count)
    part = ranges(np.zeros_like(count), count) / count[row]
    return np.asarray(ends[row, 0] + part[:, None] * (ends[row, 1] - ends[row, 0]))


def support_samples(indenter: Indenter) -> Array:
    """Distances (k,), m, from the contact point along the support's axis, one radius apart."""
    count = max(int(np.ceil(indenter.support_height / indenter.column_radius)), 1)
    return np.asarray(indenter.radius + np.linspace(0.0, indenter.support_height, count + 1))


@dataclass(frozen=True)
class ArmCapsules:
    """The arm's links as capsules."""

    names: tuple[str, ...]
    """Link of each capsule (l,); a link may have several."""
    radii: Array
    """(l,), m."""
    ends: RowFunction
    """q (n,) -> (3, 2 l + 1): ends of the capsules' axes, and the arm's tip, world frame, m."""
    notes: tuple[str, ...] = ()
    """Links whose shape could not be read, and the reason."""

    @functools.cached_property
    def spheres(self) -> tuple[NDArray[np.intp], Array]:
        """Number of spheres (l,) that cover each capsule, and their radii (l,), m."""
        ends = self.at(np.zeros((1, self.ends.function.size1_in(0))))[0]
        lengths = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
        return link_shapes.covering_spheres(lengths, self.radii)

    def points(self, q: Array) -> Array:
        """The columns of `ends` (k, 2 l + 1, 3) in postures (k, n), world frame, m."""
        return self.ends(q).reshape(len(q), -1, 3)

    def at(self, q: Array) -> Array:
        """Ends (k, l, 2, 3) of the capsules in postures (k, n), world frame, m."""
        return self.capsules(self.points(q))

    def capsules(self, points: Array) -> Array:
        """Ends (k, l, 2, 3) among `points` (k, 2 l + 1, 3)."""
        return points[:, :-1].reshape(len(points), len(self.names), 2, 3)


@functools.lru_cache(maxsize=16)
def arm_capsules(arm: Arm) -> ArmCapsules:
    """The capsules of an arm's links that have a length or a shape.

    Raises ArmError for a bad shape.
    """
    q = ca.SX.sym("q", len(arm.joint_names))
    poses, ends, names, radii, notes = arm.link_poses(q), [], [], [], []
    for joint, pose in zip(arm.chain, poses[:-1], strict=True):
        found, missing = link_shapes.link_capsules(arm.tree.links[joint.parent], arm.folders)
        if (missing or not found) and np.linalg.norm(joint.xyz) > 1e-6:
            found = [*found, link_shapes.Capsule(np.zeros(3), joint.xyz, LINK_RADIUS)]
        notes += [f"link {joint.parent}: {reason}" for reason in missing]
        for capsule in found:
            ends += [pose[:3, :3] @ end + pose[:3, 3] for end in (capsule.start, capsule.end)]
            names.append(joint.parent)
            radii.append(capsule.radius)
    function = RowFunction.compiled("links", q, ca.horzcat(*ends, poses[-1][:3, 3]))
    return ArmCapsules(tuple(names), np.array(radii), function, tuple(notes))


@dataclass(frozen=True)
class AllowedCollisions:
    """The spheres (p,) of an arm's links that are not checked against the body on its tip."""

    everywhere: NDArray[np.bool_]
    """(p,): in the body in every posture, or of a link that is fixed to the tip."""
    near_tip: NDArray[np.bool_]
    """(p,): of a link that meets the body in every posture: allowed within WRIST_RADIUS of the
    tip."""
    names: tuple[str, ...] = ()
    """Links that meet the body in every posture though a joint moves them."""

    @property
    def notes(self) -> tuple[str, ...]:
        """One sentence per link that is not checked near the tip."""
        text = (
            f"meets the body in every posture; within {WRIST_RADIUS:g} m of the tip it counts as "
            "mount"
        )
        return tuple(f"link {name}: {text}" for name in self.names)


def allowed_collisions(arm: Arm, body: Body, mount: Array) -> AllowedCollisions:
    """The spheres of an arm that cannot be clear of a body at T_tip_body `mount` (4, 4)."""
    shape = arm_capsules(arm)
    low = np.where(np.isfinite(arm.lower), arm.lower, -np.pi)
    high = np.where(np.isfinite(arm.upper), arm.upper, np.pi)
    q = np.random.default_rng(0).uniform(low, high, (RANDOM_POSTURES, len(low)))
    points = _in_frames(arm.pose(q) @ mount, shape.points(q))
    counts = shape.spheres[0]
    owner = np.repeat(np.arange(len(counts)), counts)
    meets = np.zeros((RANDOM_POSTURES, len(owner)), dtype=bool)
    meets[_sphere_collisions(shape, points, body, None)] = True
    names = np.array(shape.names, dtype=object)[owner]
    fixed = np.isin(names, _fixed_to_tip(arm))
    met = [k for k in dict.fromkeys(names[~fixed]) if meets[:, names == k].any(axis=1).all()]
    return AllowedCollisions(fixed | meets.all(axis=0), np.isin(names, met), tuple(met))


def _fixed_to_tip(arm: Arm) -> list[str]:
    """The links that are fixed to the tip, itself included."""
    fixed = takewhile(lambda joint: joint.kind == "fixed", reversed(arm.chain))
    return [arm.tip, *(joint.parent for joint in fixed)]


def arm_reasons(
    arm: Arm,
    body: Body,
    q: Array,
    poses: Array,
    indenter: Indenter | None,
    allowed: AllowedCollisions | None = None,
) -> NDArray[np.object_]:
    """Reason (k,) why postures (k, n) with the body at T_w_b `poses` (k, 4, 4) collide, or "".

    indenter: the fixed one, whose support is an obstacle; None: there is none. allowed: the spheres
    that are not checked against the body; None: all are checked.
    """
    reason, shape = np.full(len(q), "", dtype=object), arm_capsules(arm)
    if shape.names:
        for first in range(0, len(q), BATCH):
            rows = slice(first, first + BATCH)
            points, pose = shape.points(q[rows]), poses[rows]
            if indenter is not None:
                reason[rows][_support_collisions(shape, points, indenter)] = ARM_SUPPORT
            reason[rows][_sphere_collisions(shape, _in_frames(pose, points), body, allowed)[0]] = (
                ARM_BODY
            )
    return reason


@functools.lru_cache(maxsize=4)
def _distance_grid(surface: Surface, margin: float) -> DistanceGrid:
    return DistanceGrid(surface, margin)


def _in_frames(poses: Array, points: Array) -> Array:
    """Points (k, p, 3), world frame, in frames at `poses` (k, 4, 4)."""
    return np.asarray((points - poses[:, None, :3, 3]) @ poses[:, :3, :3])


def _support_collisions(shape: ArmCapsules, points: Array, indenter: Indenter) -> NDArray[np.bool_]:
    """Which postures (k,), with links at `points` (k, 2 l + 1, 3), world, meet the support."""
    ends, out = shape.capsules(points), np.zeros(len(points), dtype=bool)
    top = np.array(indenter.position)
    foot = top - (indenter.radius + indenter.support_height) * indenter.axis
    distance = shape.radii + indenter.column_radius
    k, link = np.nonzero(link_shapes.box_distance(ends, np.sort([foot, top], axis=0)) < distance)
    gap = link_shapes.segment_distance(ends[k, link, 0], ends[k, link, 1], top, foot)
    out[k[gap < distance[link]]] = True
    return out


def _sphere_collisions(
    shape: ArmCapsules, points: Array, body: Body, allowed: AllowedCollisions | None
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Pairs of a posture and a sphere that meets the body, among the spheres that are checked.

    points (k, 2 l + 1, 3): the links, in the body's frame.
    """
    ends, (counts, radii) = shape.capsules(points), shape.spheres
    k, link = np.nonzero(link_shapes.box_distance(ends, body.mesh.bounds) < radii)
    owner, number, part = link_shapes.sphere_samples(counts[link])
    k, link = k[owner], link[owner]
    sphere = (np.cumsum(counts) - counts)[link] + number
    at = ends[k, link, 0] * (1 - part) + ends[k, link, 1] * part
    near = link_shapes.box_distance(at[:, None], body.mesh.bounds) < radii[link]
    if allowed is not None:
        wrist = np.linalg.norm(at - points[k, -1], axis=-1) <= WRIST_RADIUS
        near &= ~(allowed.everywhere[sphere] | (allowed.near_tip[sphere] & wrist))
    if near.any():
        grid = _distance_grid(body.surface, float(radii.max()))
        near[near] = grid.within(at[near], radii[link[near]])
    return k[near], sphere[near]
