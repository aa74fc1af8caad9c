"""The shapes of an arm's links as capsules, each of which holds its part of the link.

Boxes, cylinders and spheres are one capsule each; a mesh is cut into slabs across its longest
direction, each held by the smallest of three capsules. What holds the surface holds the solid, as
capsules are convex.

Source of the enclosing circles: Badoiu, Clarkson, "Smaller core-sets for balls" (SODA 2003).
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from ..core.errors import MeshError
from ..core.se3 import Array, transform
from ..geometry.mesh import collada, mesh_file
from .urdf import rotation, vector

SLAB = 0.06
"""Least width of the slabs that a mesh is cut into, m."""
SLABS = 8
"""Most slabs of a mesh."""
SIDES = 16
"""Corners of the polygon that stands about a cylinder."""
CENTRINGS = 60
"""Steps towards the middle of an enclosing circle."""


@dataclass(frozen=True)
class Capsule:
    """What lies within `radius`, m, of the straight from `start` to `end` (3,), m."""

    start: Array
    end: Array
    radius: float

    @property
    def volume(self) -> float:
        """In m^3."""
        length = float(np.linalg.norm(self.end - self.start))
        return float(np.pi * self.radius**2 * (length + 4.0 / 3.0 * self.radius))


def of_link(link: ET.Element, folders: Iterable[str]) -> tuple[list[Capsule], list[str]]:
    """The capsules about a link's shapes, link frame, and what of them could not be read.

    Its collision shapes; its visual ones where it has no others, or none that can be read.
    """
    lacking: list[str] = []
    for kind in ("collision", "visual"):
        found: list[Capsule] = []
        missing: list[str] = []
        for element in link.findall(kind):
            try:
                found += _capsules(element, folders)
            except MeshError as error:
                missing.append(str(error))
        if found:
            return found, missing
        lacking = lacking or missing
    return [], lacking


def _capsules(element: ET.Element, folders: Iterable[str]) -> list[Capsule]:
    """The capsules about one shape. Raises MeshError for a mesh that cannot be had."""

    def numbers(e: ET.Element | None, key: str, default: str) -> Array:
        return vector(e, key, default, len(default.split()), " of a link's shape")

    origin = element.find("origin")
    pose = transform(rotation(numbers(origin, "rpy", "0 0 0")), numbers(origin, "xyz", "0 0 0"))
    box, cylinder, sphere, mesh = (
        element.find(f"geometry/{k}") for k in ("box", "cylinder", "sphere", "mesh")
    )
    if sphere is not None:
        return [Capsule(pose[:3, 3], pose[:3, 3], float(numbers(sphere, "radius", "0")[0]))]
    if box is not None:
        signs = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
        clouds = [signs * 0.5 * numbers(box, "size", "0 0 0")]
    elif cylinder is not None:
        turn = 2 * np.pi * np.arange(SIDES) / SIDES
        rim = numbers(cylinder, "radius", "0")[0] / np.cos(np.pi / SIDES)
        half = 0.5 * numbers(cylinder, "length", "0")[0]
        ring = np.stack([rim * np.cos(turn), rim * np.sin(turn), np.full(SIDES, half)], axis=1)
        clouds = [np.concatenate([ring, ring * [1.0, 1.0, -1.0]])]
    elif mesh is not None:
        path = located(mesh.get("filename", ""), folders)
        read = collada.read(path) if path.suffix.lower() == ".dae" else mesh_file.read(path)
        clouds = slabs(read.vertices * numbers(mesh, "scale", "1 1 1"), read.faces)
    else:
        return []
    return [about(cloud @ pose[:3, :3].T + pose[:3, 3]) for cloud in clouds]


def located(name: str, folders: Iterable[str]) -> Path:
    """The file that a URDF names by a path, `file://` or `package://`, under one of the `folders`.

    The whole path counts first, then what is left of it without its first folders. Raises
    MeshError.
    """
    bare = name.partition("://")[2] or name
    if Path(bare).is_absolute() and Path(bare).is_file():
        return Path(bare)
    parts = PurePosixPath(bare.lstrip("/")).parts
    where = [Path(folder) for folder in folders]
    for k in range(len(parts)):
        for folder in where:
            if (path := folder.joinpath(*parts[k:])).is_file():
                return path
    raise MeshError(
        f"the mesh {name!r} is in none of the arm's folders",
        remedy="give Arm.from_urdf folders=, or [arm] folders in the scene",
    )


def slabs(vertices: Array, faces: NDArray[np.intp]) -> list[Array]:
    """Points (k, 3) whose hulls hold the parts of a mesh between planes across its length."""
    middle = vertices.mean(axis=0)
    along = (vertices - middle) @ _axes(vertices - middle)[0]
    low, high = float(along.min()), float(along.max())
    count = int(np.clip((high - low) // SLAB, 1, SLABS))
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


def about(points: Array) -> Capsule:
    """A small capsule that holds points (k, 3): along one of their three principal directions."""
    middle = points.mean(axis=0)
    axes = _axes(points - middle)
    found = [_along(points, middle, np.roll(axes, -k, axis=0)) for k in range(3)]
    return min(found, key=lambda capsule: capsule.volume)


def _axes(offset: Array) -> Array:
    """The principal directions (3, 3), a row each, of offsets (k, 3), the longest first."""
    return np.asarray(np.linalg.eigh(offset.T @ offset)[1].T[::-1])


def _along(points: Array, middle: Array, axes: Array) -> Capsule:
    """The shortest capsule along the first of `axes` (3, 3) about the circle across it."""
    along, *across = ((points - middle) @ axis for axis in axes)
    flat = np.stack(across, axis=1)
    centre, off = _encircled(flat)
    radius = float(off.max())
    room = np.sqrt(np.maximum(radius**2 - off**2, 0.0))
    low, high = float((along + room).min()), float((along - room).max())
    if low > high:  # a ball about any place between holds them all
        low = high = 0.5 * (low + high)
    base = middle + centre @ axes[1:]
    return Capsule(base + low * axes[0], base + high * axes[0], radius)


def _encircled(flat: Array) -> tuple[Array, Array]:
    """The middle (2,) of about the smallest circle that holds points (k, 2), and how far (k,) they
    are from it.
    """
    middle = best = 0.5 * (flat.min(axis=0) + flat.max(axis=0))
    least = off = np.linalg.norm(flat - middle, axis=1)
    for k in range(1, CENTRINGS):
        middle = middle + (flat[np.argmax(off)] - middle) / (k + 1)
        off = np.linalg.norm(flat - middle, axis=1)
        if off.max() < least.max():
            best, least = middle, off
    return best, least
