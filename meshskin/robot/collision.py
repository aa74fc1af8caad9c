"""What must not meet while a body is pressed on its indenter.

The indenter is the tip of a thin column, its support. It must fit the surface where it touches (one
contact, no narrower hollow), and the column must keep clear of the body and of the arm; the arm's
links must keep clear of the body. Links are capsules about their shapes (motion/shapes.py); where
the URDF has none, or names a mesh that is not there, straight from joint to joint with
`LINK_RADIUS`. Links that are rigid with the tip, and what is in the body in every posture, are its
mount and not judged; nor is, within `WRIST` of the tip, a link that meets it in every posture.

Source of the mount: Coleman, Sucan, Chitta, Correll, "Reducing the barrier to entry of complex
robotic software: a MoveIt! case study" (Journal of Software Engineering for Robotics 5(1), 2014),
whose setup leaves out pairs of links that meet in every one of some random postures.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..contact.indenter import Indenter
from ..core.arrays import ranges
from ..core.se3 import Array
from ..geometry.body import Body
from . import link_shapes
from .arm import Arm
from .capsules import apart, covering, segment_distance, spread
from .urdf import chain, parse

LINK_RADIUS = 0.03
"""Radius of a link of which nothing but its joints is known, m."""
WRIST = 0.12
"""Distance from the tip, m, within which a link that always meets the body is taken for part of its
mount, that the guess of a link's thickness may not forbid to bend the wrist."""
POSTURES = 200
"""Random postures in which the arm is looked at for what always meets the body."""
EDGY = np.cos(np.deg2rad(20.0))
"""Cosine of the turn of the surface's normal from which a crease is an edge: the indenter runs over
what turns less, as over the facets of a coarse mesh of something round."""
ALONG = (0.1, 0.5, 0.9)
"""Parts of an edge at which its normals are compared."""
BATCH = 4096
"""Configurations looked at together."""
ROUND = 1e-3
"""Relative slack within which a sphere counts as touching at one point only."""

HOLLOW = "concave: the indenter does not fit"
EDGE = "edge: the contact patch would run over it"
SUPPORT = "collision: the indenter's support meets the body"
ARM_SUPPORT = "collision: the arm meets the indenter's support"
ARM_BODY = "collision: the arm meets the body"


def contact_reasons(
    body: Body, points: Array, normals: Array, indenter: Indenter, depth: float
) -> Array:
    """Why the indenter cannot be pressed `depth` (m) in at `points` (k, 3): strings, "" where it
    can. normals (k, 3): outward; the support stands along them, as they face straight against it.

    A sphere larger than the indenter by the depth must touch the body there and nowhere else.
    """
    reason = np.full(len(points), "", dtype=object)
    if not len(points):
        return reason
    clear = column(indenter)
    thick = indenter.column_radius
    # columns are sampled as finely as thick: half a step off the axis costs 12 % at most
    far = body.closest((points[:, None] + clear[:, None] * normals[:, None]).reshape(-1, 3))
    near = far.distance.reshape(len(points), -1).min(axis=1)
    reason[near < 1.12 * thick] = SUPPORT
    large = indenter.radius + depth
    reason[body.closest(points + large * normals).distance < large * (1 - ROUND)] = HOLLOW
    return reason


def edge_points(body: Body, spacing: float) -> Array:
    """Points (k, 3), at most `spacing` apart, on the body's edges and borders, body frame, m.

    An edge is where the smooth surface's normal jumps; where only its curvature does is none.
    """
    surface = body.surface
    if surface.smooth:
        return np.zeros((0, 3))
    beyond, slot = surface.neighbours.ravel(), surface.slot.ravel()
    face, corner = np.divmod(np.arange(beyond.size), 3)
    once = np.flatnonzero(beyond < face)  # borders, and every inner edge from one side
    face, corner, beyond, slot = (x[once] for x in (face, corner, beyond, slot))
    jump, inner = beyond < 0, np.flatnonzero(beyond >= 0)
    for part in ALONG:
        here = surface.at(face[inner], _along(corner[inner], part)).normal
        there = surface.at(beyond[inner], _along(slot[inner], 1.0 - part)).normal
        jump[inner] |= np.sum(here * there, axis=1) < EDGY
    face, corner = face[jump], corner[jump]
    ends = [surface.vertices[surface.faces[face, (corner + k) % 3]] for k in (1, 2)]
    count = np.ceil(np.linalg.norm(ends[1] - ends[0], axis=1) / spacing).astype(int) + 1
    row = np.repeat(np.arange(len(count)), count)
    part = ranges(np.zeros_like(count), count) / count[row]
    return np.asarray(ends[0][row] + part[:, None] * (ends[1] - ends[0])[row])


def _along(corner: NDArray[np.intp], part: float) -> Array:
    """Where (k, 2) a `part` of the side opposite each corner (k,) of a face is behind."""
    weight, row = np.zeros((len(corner), 3)), np.arange(len(corner))
    weight[row, (corner + 1) % 3], weight[row, (corner + 2) % 3] = 1.0 - part, part
    return weight[:, 1:]


def near_points(points: Array, others: Array, radius: float) -> NDArray[np.bool_]:
    """Which points (k, 3) have one of the `others` (e, 3) within `radius`, m."""
    from scipy.spatial import cKDTree

    if not len(others) or not len(points):
        return np.zeros(len(points), dtype=bool)
    return np.asarray(cKDTree(others).query(points)[0] < radius)


def column(indenter: Indenter) -> Array:
    """Distances (k,), m, from the contact point along the support's axis at which it is sampled."""
    count = max(int(np.ceil(indenter.support_height / indenter.column_radius)), 1)
    return np.asarray(indenter.radius + np.linspace(0.0, indenter.support_height, count + 1))


@dataclass(frozen=True)
class Links:
    """The arm's links as capsules."""

    names: tuple[str, ...]
    """(l,): the link of each; a link may have several."""
    radii: Array
    """(l,), m."""
    ends: ca.Function
    """q (n,) -> (3, 2 l + 1): the two ends of each capsule's axis, and the arm's tip, world."""
    notes: tuple[str, ...] = ()
    """Which links are taken for a capsule from joint to joint though they have a shape, and why."""

    @functools.cached_property
    def balls(self) -> tuple[NDArray[np.intp], Array]:
        """How many balls (l,) stand for each capsule, and their radii (l,), m."""
        ends = self.at(np.zeros((1, self.ends.size1_in(0))))[0]
        return covering(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1), self.radii)

    def points(self, q: Array) -> Array:
        """The columns of `ends` (k, 2 l + 1, 3), world, m, in configurations (k, n)."""
        return np.asarray(self.ends(q.T).full().T.reshape(len(q), -1, 3))

    def at(self, q: Array) -> Array:
        """Ends (k, l, 2, 3), world, m, in configurations (k, n)."""
        return self.capsules(self.points(q))

    def capsules(self, points: Array) -> Array:
        """Ends (k, l, 2, 3) among `points` (k, 2 l + 1, 3)."""
        return points[:, :-1].reshape(len(points), len(self.names), 2, 3)


@functools.lru_cache(maxsize=16)
def links(arm: Arm) -> Links:
    """The links of `arm` that have a length or a shape. Raises ArmError for a bad shape."""
    robot = parse(arm.urdf, "")
    elements = {e.get("name", ""): e for e in robot.findall("link")}
    q = ca.SX.sym("q", len(arm.joint_names))
    driven = {by.joint.name: by for by in arm.driven}
    pose, ends, names, radii, notes = ca.SX(ca.sparsify(ca.DM(arm.base))), [], [], [], []
    for joint in chain(robot, arm.tip, ""):
        found, missing = link_shapes.of_link(elements[joint.parent], arm.folders)
        if (missing or not found) and np.linalg.norm(joint.xyz) > 1e-6:
            found = [*found, link_shapes.Capsule(np.zeros(3), joint.xyz, LINK_RADIUS)]
        notes += [f"link {joint.parent}: {why}" for why in missing]
        for capsule in found:
            ends += [pose[:3, :3] @ end + pose[:3, 3] for end in (capsule.start, capsule.end)]
            names.append(joint.parent)
            radii.append(capsule.radius)
        by = driven.get(joint.name)
        pose = pose @ joint.motion(by.position(q) if by else 0.0)
    every = ca.densify(ca.horzcat(*ends, pose[:3, 3]))
    function = ca.Function("links", [q], [every], {"cse": True})
    return Links(tuple(names), np.array(radii), function, tuple(notes))


@dataclass(frozen=True)
class Mounted:
    """What of an arm's links, as balls in order (p,), is not judged against the body on its tip."""

    inside: NDArray[np.bool_]
    """(p,): in the body in every posture, or of a link that is rigid with the tip."""
    joined: NDArray[np.bool_]
    """(p,): of a link that meets the body in every posture; left out within WRIST of the tip."""
    names: tuple[str, ...] = ()
    """The links that meet the body in every posture though a joint moves them."""

    @property
    def notes(self) -> tuple[str, ...]:
        """What was left out, in words."""
        why = f"meets the body in every posture; within {WRIST:g} m of the tip it counts as mount"
        return tuple(f"link {name}: {why}" for name in self.names)


def mounted(arm: Arm, body: Body, mount: Array) -> Mounted:
    """What of the arm can never be clear of a body at T_tip_b `mount` (4, 4)."""
    shape = links(arm)
    low = np.where(np.isfinite(arm.lower), arm.lower, -np.pi)
    high = np.where(np.isfinite(arm.upper), arm.upper, np.pi)
    q = np.random.default_rng(0).uniform(low, high, (POSTURES, len(low)))
    points = _seen_from(arm.pose(q) @ mount, shape.points(q))
    counts = shape.balls[0]
    owner = np.repeat(np.arange(len(counts)), counts)
    meets = np.zeros((POSTURES, len(owner)), dtype=bool)
    meets[_meeting(shape, points, body, None)] = True
    names = np.array(shape.names, dtype=object)[owner]
    fixed = np.isin(names, _rigid(arm))
    met = [k for k in dict.fromkeys(names[~fixed]) if meets[:, names == k].any(axis=1).all()]
    return Mounted(fixed | meets.all(axis=0), np.isin(names, met), tuple(met))


def _rigid(arm: Arm) -> list[str]:
    """The links behind which no joint moves, up to the tip."""
    links = [arm.tip]
    for joint in reversed(chain(parse(arm.urdf, ""), arm.tip, "")):
        if joint.kind != "fixed":
            break
        links.append(joint.parent)
    return links


def arm_reasons(
    arm: Arm, body: Body, q: Array, poses: Array, indenter: Indenter, held: Mounted | None = None
) -> NDArray[np.object_]:
    """Why configurations `q` (k, n) with the body at T_w_b `poses` (k, 4, 4) collide; "" if not.

    held: what of the arm is not judged against the body; None: all of it is.
    """
    reason, shape = np.full(len(q), "", dtype=object), links(arm)
    if shape.names:
        for first in range(0, len(q), BATCH):
            rows = slice(first, first + BATCH)
            points, pose = shape.points(q[rows]), poses[rows]
            reason[rows][_meets_support(shape, points, indenter)] = ARM_SUPPORT
            reason[rows][_meeting(shape, _seen_from(pose, points), body, held)[0]] = ARM_BODY
    return reason


def _seen_from(poses: Array, points: Array) -> Array:
    """Points (k, p, 3) in frames that are at `poses` (k, 4, 4)."""
    return np.asarray((points - poses[:, None, :3, 3]) @ poses[:, :3, :3])


def _meets_support(shape: Links, points: Array, indenter: Indenter) -> NDArray[np.bool_]:
    """In which configurations (k,), with links at `points` (k, 2 l + 1, 3), world, one of them
    meets the indenter's support.
    """
    ends, out = shape.capsules(points), np.zeros(len(points), dtype=bool)
    top = np.array(indenter.position)
    foot = top - (indenter.radius + indenter.support_height) * indenter.axis
    thick = shape.radii + indenter.column_radius
    k, link = np.nonzero(apart(ends, np.sort([foot, top], axis=0)) < thick)
    gap = segment_distance(ends[k, link, 0], ends[k, link, 1], top, foot)
    out[k[gap < thick[link]]] = True
    return out


def _meeting(
    shape: Links, points: Array, body: Body, held: Mounted | None
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """In which configurations which balls meet the body, a pair each, of those that are judged,
    with links at `points` (k, 2 l + 1, 3) in the body's frame.
    """
    ends, (counts, radii) = shape.capsules(points), shape.balls
    k, link = np.nonzero(apart(ends, body.mesh.bounds) < radii)
    owner, place, part = spread(counts[link])
    k, link = k[owner], link[owner]
    ball = (np.cumsum(counts) - counts)[link] + place
    at = ends[k, link, 0] * (1 - part) + ends[k, link, 1] * part
    near = apart(at[:, None], body.mesh.bounds) < radii[link]
    if held is not None:
        wrist = np.linalg.norm(at - points[k, -1], axis=-1) <= WRIST
        near &= ~(held.inside[ball] | (held.joined[ball] & wrist))
    if near.any():
        near[near] = body.closest(at[near]).distance < radii[link[near]]
    return k[near], ball[near]
