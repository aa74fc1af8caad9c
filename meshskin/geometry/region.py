"""Regions of the surface of a body, on which skins are laid out, and their centres."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.arguments import check_real
from ..core.arrays import Array
from ..core.config import quantity
from ..core.errors import SkinError
from ..core.value import Value
from .body import Body
from .geodesics import within
from .mesh.triangles import subdivision_centroids
from .surface.closest_point import Closest

SHOWN = 20
"""most names of patches listed in a message"""


@runtime_checkable
class Region(Protocol):
    """A part of a surface, with a centre on it."""

    def contains(self, body: Body, at: Closest) -> NDArray[np.bool_]:
        """Which (n,) of the surface points belong to the region."""
        ...

    def centre(self, body: Body) -> Closest:
        """The centre of the region: one surface point."""
        ...


@dataclass(frozen=True)
class Whole:
    """The whole surface, with the outermost point in a direction as its centre."""

    direction: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """body frame; need not be a unit vector"""

    def contains(self, body: Body, at: Closest) -> NDArray[np.bool_]:
        """Every point."""
        return np.ones(len(at.face), dtype=bool)

    def centre(self, body: Body) -> Closest:
        """The outermost point in the direction from the body's middle."""
        return outermost(body, self.direction)


@dataclass(frozen=True)
class Cap:
    """The points within an angle of a direction, seen from the centre of the bounding box."""

    direction: tuple[float, float, float] = quantity("")
    """body frame; need not be a unit vector"""
    angle: float = quantity("rad", np.pi, above=0.0, most=np.pi)
    """largest angle, in rad"""

    def __post_init__(self) -> None:
        check_real("cap.angle", self.angle, "rad", above=0.0, most=np.pi)

    def contains(self, body: Body, at: Closest) -> NDArray[np.bool_]:
        """The points within the angle."""
        outward = at.point - bounding_box_centre(body)
        away = np.linalg.norm(outward, axis=1) * np.cos(self.angle)
        return np.asarray(outward @ _unit(self.direction) >= away - 1e-15)

    def centre(self, body: Body) -> Closest:
        """The outermost point in the direction."""
        return outermost(body, self.direction)


@dataclass(frozen=True)
class Disc:
    """The points within a geodesic distance of a point of the surface."""

    point: tuple[float, float, float] = quantity("m")
    """body frame, m; replaced by its closest surface point"""
    radius: float = quantity("m", above=0.0)
    """geodesic radius, m"""

    def __post_init__(self) -> None:
        check_real("disc.radius", self.radius, "m", above=0.0)

    def contains(self, body: Body, at: Closest) -> NDArray[np.bool_]:
        """The points within the radius."""
        return within(body, self.centre(body), at, self.radius)

    def centre(self, body: Body) -> Closest:
        """The surface point closest to `point`."""
        return body.closest([self.point])


@dataclass(frozen=True)
class HalfSpace:
    """The points x with normal . x >= offset."""

    normal: tuple[float, float, float] = quantity("")
    """body frame; need not be a unit vector"""
    offset: float = quantity("m")
    """m, along the unit normal from the origin of the frame"""

    def contains(self, body: Body, at: Closest) -> NDArray[np.bool_]:
        """The points beyond the plane."""
        return np.asarray(at.point @ _unit(self.normal) >= self.offset)

    def centre(self, body: Body) -> Closest:
        """The vertex farthest beyond the plane."""
        vertices = body.surface.vertices
        return body.closest(vertices[[np.argmax(vertices @ _unit(self.normal))]])


class _OfFaces:
    """A part of a surface that consists of faces."""

    def contains(self, body: Body, at: Closest) -> NDArray[np.bool_]:
        """The points on one of the faces."""
        return np.isin(at.face, self._numbers(body))

    def centre(self, body: Body) -> Closest:
        """The face centroid nearest to the mean of the centroids."""
        centroids = face_points(body, self._numbers(body), 1)
        off = np.linalg.norm(centroids.point - centroids.point.mean(axis=0), axis=1)
        return centroids.take([int(np.argmin(off))])

    def _numbers(self, body: Body) -> NDArray[np.intp]:
        """Rows (k,) of the faces. Raises SkinError for none, or wrong ones."""
        raise NotImplementedError


@dataclass(frozen=True, eq=False)
class Faces(_OfFaces, Value):
    """Faces of a mesh: by their rows in `body.mesh.faces`, or by a mask over all of them."""

    faces: Sequence[int] | NDArray[np.intp] | NDArray[np.bool_]
    """(k,) rows, or (m,) bool"""

    def _numbers(self, body: Body) -> NDArray[np.intp]:
        given, count = np.asarray(self.faces), len(body.surface.faces)
        if given.dtype == bool:
            if given.shape != (count,):
                raise SkinError(
                    "wrong shape of a face mask", value=given.shape, limit=f"({count},)"
                )
            given = np.flatnonzero(given)
        if not given.size:
            raise SkinError("a region needs faces", value="none", limit="at least 1")
        if given.dtype.kind not in "iu" or given.min() < 0 or given.max() >= count:
            wrong = given if given.dtype.kind not in "iu" else given[(given < 0) | (given >= count)]
            raise SkinError("no such face", value=wrong.flat[0], limit=f"0 to {count - 1}")
        return given.astype(np.intp)


@dataclass(frozen=True)
class Patch(_OfFaces):
    """A part of the body by its name in the mesh file: see `Body.patches`."""

    patch: str
    """a key of `Body.patches`"""

    def _numbers(self, body: Body) -> NDArray[np.intp]:
        found = body.patches.get(self.patch)
        if found is None:
            raise SkinError(
                f"no patch {self.patch!r} on {body.name}",
                remedy=_known(self.patch, [*body.patches]),
            )
        if not len(found):
            raise SkinError(f"patch {self.patch!r} of {body.name} has no faces after repairs")
        return found


@dataclass(frozen=True)
class Exposed:
    """The points of a region that no other part of the body covers."""

    region: Region

    def contains(self, body: Body, at: Closest) -> NDArray[np.bool_]:
        """The points of the region that are not covered."""
        found = np.array(self.region.contains(body, at))
        found[found] = ~body.surface.buried(at.take(found))
        return found

    def centre(self, body: Body) -> Closest:
        """The region's centre, or where that is covered the nearest face centroid that is not."""
        centre = self.region.centre(body)
        if self.contains(body, centre)[0]:
            return centre
        faces = face_points(body, np.arange(len(body.surface.faces)), 1)
        faces = faces.take(self.contains(body, faces))
        if not len(faces.face):
            return centre
        away = np.linalg.norm(faces.point - centre.point, axis=1)
        return faces.take([int(np.argmin(away))])


@dataclass(frozen=True, eq=False)
class Around:
    """The points of a region within a geodesic distance of one of its points."""

    region: Region
    middle: Closest
    """one point"""
    radius: float
    """m"""

    def contains(self, body: Body, at: Closest) -> NDArray[np.bool_]:
        """The points of the region within the radius."""
        found = within(body, self.middle, at, self.radius)
        found[found] = self.region.contains(body, at.take(found))
        return found

    def centre(self, body: Body) -> Closest:
        """The point `middle`."""
        return self.middle


def _known(name: str, names: list[str]) -> str:
    """The remedy where a name is not among those of the patches of a body."""
    if not names:
        return (
            "its file has no named parts (objects, groups and materials of an OBJ; nodes, meshes "
            "and materials of a GLB); give a disc, a half-space or faces"
        )
    near = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    few, more = ", ".join(sorted(names)[:SHOWN]), len(names) - SHOWN
    listed = f"it has {few}" + (f" and {more} more" if more > 0 else "")
    return f"did you mean {near[0]}? {listed}" if near else listed


def exposed(body: Body, region: Region | str | None) -> Region:
    """The part of a region that no other part of the body covers; region: a Region, the name of a
    patch, or None for the whole surface. Raises SkinError."""
    found = Patch(region) if isinstance(region, str) else Whole() if region is None else region
    if not isinstance(found, Region):
        raise SkinError("a region must be the name of a patch or a Region", value=repr(region))
    return Exposed(found) if body.surface.covered else found


def bounding_box_centre(body: Body) -> Array:
    """The centre (3,) of the bounding box, m."""
    return np.asarray(body.surface.bounds.mean(axis=0))


def outermost(body: Body, direction: ArrayLike) -> Closest:
    """The outermost point on the ray from the centre of the bounding box, or that nearest to it."""
    unit, centre = _unit(direction), bounding_box_centre(body)
    far = centre + 2.0 * body.surface.scale * unit
    hit = body.project([far], [-unit])
    if hit.face[0] >= 0:
        return hit
    return body.closest([far])


def area(body: Body, region: Region) -> float:
    """Area of a region in m^2: that of the flat faces, by the share of each within the region.

    The share is taken at the centroid, and near the border of the region at those of 9 parts.
    """
    surface = body.surface
    a, b, c = (surface.vertices[surface.faces[:, k]] for k in range(3))
    areas = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    if isinstance(region, Whole):
        return float(areas.sum())
    share = region.contains(body, face_points(body, np.arange(len(areas)), 1)).astype(float)
    neighbours = share[surface.neighbours]
    border = np.flatnonzero(
        np.any((neighbours != share[:, None]) & (surface.neighbours >= 0), axis=1)
    )
    if len(border):
        within = region.contains(body, face_points(body, border, 3))
        share[border] = within.reshape(len(border), -1).mean(axis=1)
    return float(areas @ share)


def face_points(body: Body, faces: NDArray[np.intp], cuts: int) -> Closest:
    """The smooth surface at the centroids of the cuts^2 equal parts of each face (n,)."""
    uv = subdivision_centroids(cuts)[:, 1:]
    return body.surface.at(np.repeat(faces, len(uv)), np.tile(uv, (len(faces), 1)))


def _unit(vector: ArrayLike) -> Array:
    v = np.asarray(vector, dtype=float).reshape(3)
    length = np.linalg.norm(v)
    if not (np.isfinite(length) and length > 0):
        raise SkinError("a direction must be finite and not zero", value=v.tolist())
    return np.asarray(v / length)
