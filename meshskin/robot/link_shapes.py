"""Capsules that enclose the shapes of an arm's links, their distances, and spheres that cover them.

Boxes, cylinders, capsules and spheres get one capsule each; a mesh is cut into slabs across its
longest direction, and each slab gets the smallest of three capsules. A capsule that encloses the
surface encloses the solid, as it is convex.

Source of the enclosing circles: Badoiu, Clarkson, "Smaller core-sets for balls" (SODA 2003).
trimesh was weighed: it fits cylinders, boxes and spheres to a mesh, but no capsules.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import Array, ranges
from ..core.errors import MeshError
from ..core.se3 import transform
from ..geometry.mesh import mesh_file
from ..geometry.mesh.link_mesh import KINDS, find_mesh
from .urdf import rotation, vector

T = TypeVar("T")

SIZES = {
    "mesh": {"scale": "1 1 1"},
    "box": {"size": "0 0 0"},
    "sphere": {"radius": "0"},
    "cylinder": {"radius": "0", "length": "0"},
    "capsule": {"radius": "0", "length": "0"},
}
"""Attributes of each geometry of a shape, with their defaults: m, and factors of a mesh."""
MIN_SLAB = 0.06
"""Least width of the slabs that a mesh is cut into, m. Chosen: about the radius of a link."""
MAX_SLABS = 8
"""Most slabs of a mesh. Chosen: the time of the collision check grows with it."""
CYLINDER_SIDES = 16
"""Corners of the polygon about a cylinder, which is 1 / cos(pi / 16) - 1 = 2 % wider."""
CIRCLE_ITERATIONS = 60
"""Iterations of an enclosing circle: its radius is then within 1 / 60 of the least (Source)."""
SPHERE_PITCH = 0.5
"""Largest distance of the spheres that cover a capsule, relative to its radius: they then need
radii larger by 3 % only, sqrt(1 + 1/16)."""


@dataclass(frozen=True)
class Capsule:
    """All points within `radius`, m, of the segment from `start` to `end` (3,), m."""

    start: Array
    end: Array
    radius: float

    @property
    def volume(self) -> float:
        """In m^3."""
        length = float(np.linalg.norm(self.end - self.start))
        return float(np.pi * self.radius**2 * (length + 4.0 / 3.0 * self.radius))


def link_capsules(link: ET.Element, folders: Iterable[str]) -> tuple[list[Capsule], list[str]]:
    """The capsules about a link's shapes, link frame, and why shapes could not be read.

    The collision shapes are used; the visual ones if no collision shape can be read.
    """
    return of_shapes(link, KINDS[::-1], lambda shape: _capsules(shape, folders))


def of_shapes(
    link: ET.Element, kinds: Iterable[str], read: Callable[[ET.Element], list[T]]
) -> tuple[list[T], list[str]]:
    """What `read` gives of a link's shapes of the first of the kinds that can be read; the reasons
    for which it raised MeshError for shapes."""
    lacking: list[str] = []
    for kind in kinds:
        found, missing = list[T](), list[str]()
        for element in link.findall(kind):
            try:
                found += read(element)
            except MeshError as error:
                missing.append(str(error))
        if found:
            return found, missing
        lacking = lacking or missing
    return [], lacking


def geometry_of(element: ET.Element) -> tuple[str, Array, dict[str, Array]]:
    """Kind of a shape, its pose (4, 4) in the link, m, and its sizes by name, m; zero where they
    are missing. Raises ArmError for bad numbers, MeshError for an unknown geometry."""

    def numbers(e: ET.Element | None, key: str, default: str) -> Array:
        return vector(e, key, default, len(default.split()), " of a link's shape")

    origin = element.find("origin")
    pose = transform(rotation(numbers(origin, "rpy", "0 0 0")), numbers(origin, "xyz", "0 0 0"))
    for kind, sizes in SIZES.items():
        if (shape := element.find(f"geometry/{kind}")) is not None:
            return kind, pose, {key: numbers(shape, key, text) for key, text in sizes.items()}
    kinds = ", ".join(e.tag for e in element.findall("geometry/*"))
    raise MeshError("a link's shape has no known geometry", value=kinds or "none")


def _capsules(element: ET.Element, folders: Iterable[str]) -> list[Capsule]:
    """The capsules about one shape. Raises MeshError for a shape that cannot be read."""
    kind, pose, size = geometry_of(element)
    radius, length = (float(size.get(key, [0.0])[0]) for key in ("radius", "length"))
    if kind in ("sphere", "capsule"):  # the length of a capsule is that of its axis
        half = 0.5 * length * pose[:3, 2]
        ends = pose[:3, 3] - half, pose[:3, 3] + half
        return [Capsule(*ends, radius)] if radius > 0.0 else []
    if kind == "box":
        signs = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
        clouds = [signs * 0.5 * size["size"]]
    elif kind == "cylinder":
        turn = 2 * np.pi * np.arange(CYLINDER_SIDES) / CYLINDER_SIDES
        rim = radius / np.cos(np.pi / CYLINDER_SIDES)
        ring = np.stack(
            [rim * np.cos(turn), rim * np.sin(turn), np.full(CYLINDER_SIDES, 0.5 * length)], axis=1
        )
        clouds = [np.concatenate([ring, ring * [1.0, 1.0, -1.0]])]
    else:
        mesh = element.find("geometry/mesh")
        assert mesh is not None
        read = mesh_file.read(find_mesh(mesh.get("filename", ""), folders))
        clouds = slabs(read.vertices * size["scale"], read.faces)
    made = (enclosing_capsule(cloud @ pose[:3, :3].T + pose[:3, 3]) for cloud in clouds)
    return [capsule for capsule in made if capsule.radius > 0.0]


def slabs(vertices: Array, faces: NDArray[np.intp]) -> list[Array]:
    """Points (k, 3) whose convex hulls enclose the slabs of a mesh across its length."""
    middle = vertices.mean(axis=0)
    along = (vertices - middle) @ _principal_axes(vertices - middle)[0]
    low, high = float(along.min()), float(along.max())
    count = int(np.clip((high - low) // MIN_SLAB, 1, MAX_SLABS))
    ends = np.linspace(low, high, count + 1)
    a, b = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).T
    cuts = []
    for plane in ends[1:-1]:
        cross = (along[a] - plane) * (along[b] - plane) < 0.0
        u, v = a[cross], b[cross]
        part = ((plane - along[u]) / (along[v] - along[u]))[:, None]
        cuts.append((1.0 - part) * vertices[u] + part * vertices[v])
    cuts = [np.zeros((0, 3)), *cuts, np.zeros((0, 3))]
    used = np.zeros(len(vertices), dtype=bool)
    used[faces] = True
    out = []
    for k in range(count):
        within = used & (along >= ends[k]) & (along <= ends[k + 1])
        out.append(np.concatenate([vertices[within], cuts[k], cuts[k + 1]]))
    return [cloud for cloud in out if len(cloud)]


def enclosing_capsule(points: Array) -> Capsule:
    """A small capsule that encloses points (k, 3), along one of their principal directions."""
    middle = points.mean(axis=0)
    axes = _principal_axes(points - middle)
    found = [_capsule_along(points, middle, np.roll(axes, -k, axis=0)) for k in range(3)]
    return min(found, key=lambda capsule: capsule.volume)


def _principal_axes(offset: Array) -> Array:
    """The principal directions (3, 3) of offsets (k, 3), one per row, the longest first."""
    return np.asarray(np.linalg.eigh(offset.T @ offset)[1].T[::-1])


def _capsule_along(points: Array, middle: Array, axes: Array) -> Capsule:
    """The shortest capsule along the first of `axes` (3, 3), as wide as the points across it."""
    along, *across = ((points - middle) @ axis for axis in axes)
    flat = np.stack(across, axis=1)
    centre, off = _enclosing_circle(flat)
    radius = float(off.max())
    room = np.sqrt(np.maximum(radius**2 - off**2, 0.0))
    low, high = float((along + room).min()), float((along - room).max())
    if low > high:  # a sphere about any point between encloses them all
        low = high = 0.5 * (low + high)
    base = middle + centre @ axes[1:]
    return Capsule(base + low * axes[0], base + high * axes[0], radius)


def _enclosing_circle(flat: Array) -> tuple[Array, Array]:
    """The centre (2,) of a nearly smallest circle that encloses points (k, 2), and their distances
    (k,) from it.
    """
    middle = best = 0.5 * (flat.min(axis=0) + flat.max(axis=0))
    least = off = np.linalg.norm(flat - middle, axis=1)
    for k in range(1, CIRCLE_ITERATIONS):
        middle = middle + (flat[np.argmax(off)] - middle) / (k + 1)
        off = np.linalg.norm(flat - middle, axis=1)
        if off.max() < least.max():
            best, least = middle, off
    return best, least


def box_distance(ends: Array, box: Array) -> Array:
    """Distances (...), m, from a box (2, 3) to the boxes about segments (..., 2, 3) or points
    (..., 1, 3); a segment is at least as far.
    """
    first, last = ends[..., 0, :], ends[..., -1, :]
    low, high = np.minimum(first, last), np.maximum(first, last)
    x, y, z = np.moveaxis(np.maximum(np.maximum(box[0] - high, low - box[1]), 0.0), -1, 0)
    return np.asarray(np.sqrt(x * x + y * y + z * z))


def covering_spheres(length: Array, radii: Array) -> tuple[NDArray[np.intp], Array]:
    """Number (l,) and radius (l,), m, of spheres that cover capsules of lengths and radii (l,)."""
    count = np.ceil(length / (SPHERE_PITCH * radii)).astype(np.intp) + 1
    return count, np.hypot(radii, 0.5 * length / np.maximum(count - 1, 1))


def sphere_samples(count: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
    """For `count` (k,) spheres on each of k axes, in order: the axis (p,) of each sphere, its
    number (p,) there, and its relative position (p, 1).
    """
    owner = np.repeat(np.arange(len(count)), count)
    number = ranges(np.zeros_like(count), count)
    return owner, number, (number / np.maximum(count - 1, 1)[owner])[:, None]


def segment_distance(a: Array, b: Array, c: Array, d: Array) -> Array:
    """Distances (...) of segments a b (..., 3) from one segment c d (3,).

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
