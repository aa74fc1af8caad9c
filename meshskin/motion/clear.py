"""What must not meet while a body is pressed on its indenter.

The indenter is the tip of a thin vertical column, its support. It must fit the surface where it
touches (one contact, no narrower hollow), and the column must keep clear of the body and of the
arm; the arm's links must keep clear of the body. Links are capsules: about their collision or
visual shapes where the URDF has any of boxes, cylinders and spheres, else straight from joint to
joint with `LINK_RADIUS`. Links that meet the tip are left out within `WRIST` of it.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass

import casadi as cs
import numpy as np
from numpy.typing import NDArray

from ..geometry.body import Body
from ..physics.indenter import Indenter
from ..se3 import Array, transform
from .arm import Arm
from .urdf import chain, parse, rotation

LINK_RADIUS = 0.03
"""Radius of a link of which nothing but its joints is known, m."""
WRIST = 0.12
"""Distance from the tip within which the arm is taken for part of the mount, m."""
EDGY = np.cos(np.deg2rad(20.0))
"""Cosine of the turn of the surface's normal from which a crease is an edge: the indenter runs over
what turns less, as over the facets of a coarse mesh of something round."""
ALONG = (0.1, 0.5, 0.9)
"""Parts of an edge at which its normals are compared."""
SAMPLES = 9
"""Points along a link at which its distance from the body is taken."""
ROUND = 1e-3
"""Relative slack within which a sphere counts as touching at one point only."""

HOLLOW = "concave: the indenter does not fit"
EDGE = "edge: the contact patch would run over it"
SUPPORT = "collision: the indenter's support meets the body"
ARM_SUPPORT = "collision: the arm meets the indenter's support"
ARM_BODY = "collision: the arm meets the body"


def fits(body: Body, points: Array, normals: Array, indenter: Indenter, depth: float) -> Array:
    """Why the indenter cannot be pressed `depth` (m) in at `points` (k, 3): strings, "" where it
    can. normals (k, 3): outward; the support stands along them, as they face straight down.

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


def edges(body: Body, spacing: float) -> Array:
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
    part = (np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count)) / count[row]
    return np.asarray(ends[0][row] + part[:, None] * (ends[1] - ends[0])[row])


def _along(corner: NDArray[np.intp], part: float) -> Array:
    """Where (k, 2) a `part` of the side opposite each corner (k,) of a face is behind."""
    weight, row = np.zeros((len(corner), 3)), np.arange(len(corner))
    weight[row, (corner + 1) % 3], weight[row, (corner + 2) % 3] = 1.0 - part, part
    return weight[:, 1:]


def on_edges(points: Array, brink: Array, patch: float) -> NDArray[np.bool_]:
    """Which contact points (k, 3) have one of the points `brink` (e, 3) within `patch`, m."""
    from scipy.spatial import cKDTree

    if not len(brink) or not len(points):
        return np.zeros(len(points), dtype=bool)
    return np.asarray(cKDTree(brink).query(points)[0] < patch)


def column(indenter: Indenter) -> Array:
    """Distances (k,), m, from the contact point down the support's axis at which it is sampled."""
    count = max(int(np.ceil(indenter.support_height / indenter.column_radius)), 1)
    return np.asarray(indenter.radius + np.linspace(0.0, indenter.support_height, count + 1))


@dataclass(frozen=True)
class Links:
    """The arm's links as capsules."""

    names: tuple[str, ...]
    radii: Array
    """(l,), m."""
    ends: cs.Function
    """q (n,) -> (3, 2 l): the two ends of each link's axis, world."""

    def at(self, q: Array) -> Array:
        """Ends (k, l, 2, 3), world, m, in configurations (k, n)."""
        flat = self.ends(q.T).full()  # (3, k 2 l)
        return np.asarray(flat.T.reshape(len(q), len(self.names), 2, 3))


def links(arm: Arm) -> Links:
    """The links of `arm` that have a length or a shape."""
    robot = parse(arm.urdf, "")
    shapes = {e.get("name", ""): _capsule(e) for e in robot.findall("link")}
    q = cs.SX.sym("q", len(arm.joint_names))
    index = {name: k for k, name in enumerate(arm.joint_names)}
    pose, ends, names, radii = cs.SX.eye(4), [], [], []
    for joint in chain(robot, arm.tip, ""):
        shape = shapes.get(joint.parent)
        if shape is None and np.linalg.norm(joint.xyz) > 1e-6:
            shape = np.zeros(3), joint.xyz, LINK_RADIUS
        if shape is not None:
            ends += [pose[:3, :3] @ end + pose[:3, 3] for end in shape[:2]]
            names.append(joint.parent)
            radii.append(shape[2])
        pose = pose @ joint.motion(q[index[joint.name]] if joint.name in index else 0.0)
    function = cs.Function("links", [q], [cs.densify(cs.horzcat(*ends))], {"cse": True})
    return Links(tuple(names), np.array(radii), function)


def _capsule(link: ET.Element) -> tuple[Array, Array, float] | None:
    """The capsule (ends, radius), link frame, about a link's shapes; None without any."""
    points = [
        p for kind in ("collision", "visual") for e in link.findall(kind) for p in _corners(e)
    ]
    if not points:
        return None
    cloud = np.array(points)
    middle = cloud.mean(axis=0)
    way = np.linalg.svd(cloud - middle, full_matrices=False)[2][0]
    along = (cloud - middle) @ way
    radius = float(np.linalg.norm(cloud - middle - along[:, None] * way, axis=1).max())
    low, high = min(along.min() + radius, 0.0), max(along.max() - radius, 0.0)
    return middle + low * way, middle + high * way, radius


def _corners(element: ET.Element) -> Array:
    """Points (k, 3), link frame, whose hull holds a box, cylinder or sphere; none of a mesh."""

    def numbers(e: ET.Element | None, key: str, default: str) -> Array:
        return np.array([float(x) for x in (default if e is None else e.get(key, default)).split()])

    box, cylinder, sphere = (element.find(f"geometry/{k}") for k in ("box", "cylinder", "sphere"))
    if box is not None:
        half = 0.5 * numbers(box, "size", "0 0 0")
    elif cylinder is not None:
        r = numbers(cylinder, "radius", "0")[0]
        half = np.array([r, r, 0.5 * numbers(cylinder, "length", "0")[0]])
    elif sphere is not None:
        half = np.full(3, numbers(sphere, "radius", "0")[0])
    else:
        return np.zeros((0, 3))
    origin = element.find("origin")
    pose = transform(rotation(numbers(origin, "rpy", "0 0 0")), numbers(origin, "xyz", "0 0 0"))
    signs = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
    return np.asarray((signs * half) @ pose[:3, :3].T + pose[:3, 3])


def arm_reasons(
    arm: Arm, body: Body, q: Array, poses: Array, indenter: Indenter
) -> NDArray[np.object_]:
    """Why configurations `q` (k, n) with the body at T_w_b `poses` (k, 4, 4) collide; "" if not."""
    reason = np.full(len(q), "", dtype=object)
    shape = links(arm)
    if not len(q) or not shape.names:
        return reason
    ends, tip = shape.at(q), arm.pose(q)[:, :3, 3]
    top = np.array(indenter.position)
    foot = top - [0.0, 0.0, indenter.radius + indenter.support_height]
    gap = _segments(ends[:, :, 0], ends[:, :, 1], top, foot) - shape.radii
    reason[(gap < indenter.column_radius).any(axis=1)] = ARM_SUPPORT
    part = np.linspace(0.0, 1.0, SAMPLES)[:, None]
    points = ends[:, :, None, 0] * (1 - part) + ends[:, :, None, 1] * part  # (k, l, SAMPLES, 3)
    local = np.einsum("kji,klsj->klsi", poses[:, :3, :3], points - poses[:, None, None, :3, 3])
    bounds = body.mesh.bounds
    outside = np.linalg.norm(
        np.maximum(np.maximum(bounds[0] - local, local - bounds[1]), 0), axis=-1
    )
    near = outside < shape.radii[:, None]
    near &= np.linalg.norm(points - tip[:, None, None], axis=-1) > WRIST
    if near.any():
        hit = body.closest(local[near]).distance
        k, link, _ = np.nonzero(near)
        reason[np.unique(k[hit < shape.radii[link]])] = ARM_BODY
    return reason


def _segments(a: Array, b: Array, c: Array, d: Array) -> Array:
    """Distances (...) of segments a b (..., 3) from the one segment c d (3,).

    Source: Ericson, "Real-Time Collision Detection" (2005), section 5.1.9.
    """
    u, v, w = b - a, d - c, a - c
    uu, vv, uv = np.sum(u * u, -1), float(v @ v), u @ v
    uw, vw = np.sum(u * w, -1), w @ v
    det = uu * vv - uv * uv
    s = np.clip(
        np.where(det > 1e-12 * vv, (uv * vw - uw * vv) / np.where(det > 0, det, 1), 0), 0, 1
    )
    t = np.clip((uv * s + vw) / vv, 0, 1)
    s = np.clip(np.where(uu > 0, (t * uv - uw) / np.where(uu > 0, uu, 1), 0), 0, 1)
    t = np.clip((uv * s + vw) / vv, 0, 1)
    return np.asarray(np.linalg.norm(w + s[..., None] * u - t[..., None] * v, axis=-1))
