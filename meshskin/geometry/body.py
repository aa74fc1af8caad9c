"""A body: a checked triangle mesh in m, and its smooth surface."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.arguments import check_integer, check_path, check_real, check_vector, check_vectors
from ..core.arrays import Array
from ..core.errors import MeshError
from ..core.notebook import Card
from ..core.value import Value
from . import primitives
from .mesh import link_mesh, mesh_file
from .mesh.check import check_extent, check_mesh
from .mesh.rays import ray_scene
from .mesh.triangles import Triangles
from .surface import closing
from .surface.closest_point import Closest
from .surface.heights import DEGREE
from .surface.surface import Surface

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

RAY_TOLERANCE = 1e-7
"""largest distance of a hit from its ray, relative to the extent of the body"""
FACES = 5120
"""default number of faces of a primitive: see `Body.sphere` for its accuracy"""
SKINNED_DEGREE = 2
"""degree of the polynomials of a skinned surface: with higher ones the curvature of what the skin
bridges varies more"""
MAX_FACES, MAX_ASPECT = 5_000_000, 1e4
"""largest number of faces of a primitive (2.5 GB of patches), and largest ratio of its lengths"""


class Exact(Protocol):
    """The exact surface that a mesh approximates."""

    def closest(self, points: ArrayLike) -> Closest:
        """The closest points to `points` (n, 3), m, in the body frame."""
        ...

    def mesh(self, faces: int) -> tuple[Any, ...]:
        """Vertices (n, 3), m, about `faces` triangles (m, 3), and seams, if any."""
        ...


class _Mesh:
    """The field `mesh` of a body: a trimesh.Trimesh, which imports slowly, is made on first use."""

    def __get__(self, body: Body | None, owner: type) -> Any:
        if body is None:
            raise AttributeError  # the field has no default
        if isinstance(held := vars(body)["mesh"], Triangles):
            import trimesh

            self.__set__(body, trimesh.Trimesh(held.vertices, held.faces, process=False))
        return vars(body)["mesh"]

    def __set__(self, body: Body, mesh: Any) -> None:
        vars(body)["mesh"] = mesh


@dataclass(frozen=True, eq=False)
class Body(Value, Card):
    """A closed surface in the body frame, in m."""

    name: str
    """stem of the file name, or kind of primitive"""
    mesh: Any = _Mesh()
    """trimesh.Trimesh, in m, counter-clockwise faces seen from outside"""
    exact: Exact | None = None
    """the exact surface, of a primitive"""
    repairs: tuple[str, ...] = field(default=())
    """descriptions of the repairs made to the mesh when it was loaded"""
    patches: Mapping[str, NDArray[np.intp]] = field(default_factory=dict)
    """faces (k,) by the name of a part in the file, by which a skin's region can be given: objects,
    groups and materials of an OBJ, nodes, meshes and materials of a GLB, geometries and materials
    of a Collada file, solids of an ASCII STL"""
    seams: NDArray[np.intp] | None = None
    """(k, 2) edges, by their vertices, across which the curvature is known to jump"""
    degree: int = DEGREE
    """highest degree (2 to 4) of the polynomials that are fitted to the mesh"""
    crossed: NDArray[np.intp] | None = None
    """faces (k,) known to intersect others, or to have edges of more than two faces: near them the
    sign of a distance is decided by the winding number"""
    robot_mesh: Any | None = field(default=None, repr=False)
    """the mesh that the software of a robot has of the body; None: `mesh`"""

    def __repr__(self) -> str:
        size = " x ".join(f"{1e3 * x:.4g}" for x in self.mesh.extents)
        return f"<Body {self.name!r}: {len(self.mesh.faces)} faces, {size} mm>"

    def facts(self) -> dict[str, str]:
        """Name, faces, size, area, and what was repaired, for a notebook."""
        size = " x ".join(f"{1e3 * x:.4g}" for x in self.mesh.extents)
        facts = {"name": self.name, "size": f"{size} mm", "faces": f"{len(self.mesh.faces):,}"}
        facts["area"] = f"{1e4 * self.mesh.area:.4g} cm2"
        lists = {"patches": sorted(self.patches), "repairs": self.repairs}
        return facts | {name: "; ".join(texts) for name, texts in lists.items() if texts}

    def plot(self, ax: Axes | None = None) -> Figure:
        """Draw the body; ax: matplotlib axes (None: those of a new figure). Returns the figure."""
        from ..core import drawing

        return drawing.solid(ax, mesh=self.mesh, title=self.name)

    @property
    def frame(self) -> str:
        """Name of the body frame: the link, or the mesh file without its suffix."""
        return self.name.removesuffix(", skinned")

    @property
    def facets(self) -> Any:
        """The flat mesh, `vertices` (n, 3), m, and `faces`, of the robot's software."""
        return vars(self)["mesh"] if self.robot_mesh is None else self.robot_mesh

    @cached_property
    def surface(self) -> Surface:
        """The smooth surface, fitted on first use."""
        return Surface(vars(self)["mesh"], self.seams, self.degree, self.crossed)

    def closest(self, points: ArrayLike, face: ArrayLike | None = None) -> Closest:
        """Closest points of the smooth surface to `points` (n, 3), body frame, m.

        `face` (n,): faces from which the search may start, such as those of the last step; they
        change its time, not its result. Raises MeshError where a point is not finite.
        """
        return self.surface.closest(points, face)

    def project(self, origins: ArrayLike, directions: ArrayLike) -> Closest:
        """First hits of rays with the smooth surface: `origins`, `directions` (n, 3), body frame.

        The distance is that along the ray in m. A ray that misses the flat mesh or the smooth
        surface has face -1 and NaN in all other entries. The face is found on the flat mesh
        (embree, single precision), the hit on its patch. Raises MeshError where a ray is not finite
        or has no direction, and where origins and directions differ in number.
        """
        o = check_vectors("origins of rays", origins, error=MeshError)
        d = check_vectors("directions of rays", directions, error=MeshError).copy()
        if len(o) != len(d):
            counts = f"{len(o)} origins, {len(d)} directions"
            raise MeshError("a ray needs an origin and a direction", value=counts)
        length = np.linalg.norm(d, axis=1)
        if not (np.isfinite(o).all() and np.isfinite(d).all() and np.all(length > 0)):
            raise MeshError("rays must be finite, and directions not zero")
        d /= length[:, None]
        first = self._flat_hits(o, d)["primID"].astype(np.intp)
        rows = np.flatnonzero(first >= 0)
        hit = self.surface.at(*self.surface.trace(o[rows], d[rows], first[rows]))
        distance = np.sum((hit.point - o[rows]) * d[rows], axis=1)
        off_ray = np.linalg.norm(o[rows] + distance[:, None] * d[rows] - hit.point, axis=1)
        met = off_ray < RAY_TOLERANCE * self.surface.scale
        hit, rows = replace(hit, distance=distance).take(met), rows[met]
        spread = {}
        for name, values in vars(hit).items():
            missed = -1 if name == "face" else np.nan
            spread[name] = np.full((len(o), *values.shape[1:]), missed, dtype=values.dtype)
            spread[name][rows] = values
        return Closest(**spread)

    def meets(self, origins: Array, directions: Array) -> Array:
        """Distances (n,), m, along rays to the flat mesh, inf where they miss: `origins`,
        `directions` (n, 3), unit vectors, body frame."""
        found = self._flat_hits(origins, directions)
        return np.where(found["primID"] >= 0, self.surface.scale * found["tfar"], np.inf)

    def _flat_hits(self, origins: Array, directions: Array) -> dict[str, Any]:
        """First hits of rays (n, 3) with the flat mesh, as embree gives them."""
        centre, scale, scene = self.embree_scene
        start = np.ascontiguousarray((origins - centre) / scale, dtype=np.float32)
        found: dict[str, Any] = scene.run(start, directions.astype(np.float32), output=1)
        return found

    @cached_property
    def embree_scene(self) -> tuple[Array, float, Any]:
        """Centre and extent of the mesh, m, and the embree scene of it, scaled by them."""
        centre = self.surface.bounds.mean(axis=0)
        scaled = (self.surface.vertices - centre) / self.surface.scale
        return centre, self.surface.scale, ray_scene(scaled, self.surface.faces)

    @classmethod
    def load(cls, path: str | Path, units: str | None = None, open: bool = False) -> Body:
        """A body from an STL, OBJ, PLY, OFF, GLB, glTF, MuJoCo (.msh) or Collada file (.dae).

        `units` ("m", "cm", "mm", "in") is required except for glTF, whose standard is m, and for
        Collada files, which say it. With `open`, a mesh with borders is accepted. Safe repairs are
        made and listed in `.repairs`; other defects raise MeshError with the value and the remedy.
        The names of parts in the file are kept in `.patches`.
        """
        path = check_path("a mesh file", path, error=MeshError)
        raw = mesh_file.read(path, mesh_file.unit(path, units))
        return cls.from_triangles(path.stem, raw, open)

    @classmethod
    def from_mesh(cls, mesh: Any, units: str = "m", name: str = "mesh", open: bool = False) -> Body:
        """A body from a mesh in memory: a trimesh.Trimesh, or another object with its arrays.

        These are `vertices` (n, 3) in `units` ("m", "cm", "mm", "in") and `faces` (m, 3), indices
        of vertices, counter-clockwise seen from outside. `name` is that of the body frame. The mesh
        is checked and repaired as by `load`. Raises MeshError.
        """
        raw = Triangles.of_mesh(mesh, mesh_file.in_metres(units))
        return cls.from_triangles(name, raw, open)

    @classmethod
    def from_urdf(
        cls,
        path: str | Path,
        link: str,
        folders: Iterable[str | Path] = (),
        kind: str = "visual",
        open: bool = False,
    ) -> Body:
        """The body of a link in a URDF file, in the link frame, with scale and origin of its mesh.

        `folders`: searched for the mesh (`package://...`), besides the file's folder and its
        parents, as `Arm.from_urdf` does; `kind`: "visual" or "collision"; `open`: as of `load`.
        Several meshes of the link become one. Raises MeshError, UnknownNameError.
        """
        path = check_path("a URDF file", path, error=MeshError)
        raw = link_mesh.read(path, link, folders, kind)
        return cls.from_triangles(link, raw, open)

    @classmethod
    def from_triangles(cls, name: str, raw: Triangles, open: bool) -> Body:
        """The body of the triangles of a file, m, checked and repaired; `open`: as of `load`.

        Raises MeshError.
        """
        found = check_mesh(raw.vertices, raw.faces, open)
        for finding in found.refused:
            raise finding.error()
        check_extent(found.vertices)
        mesh, patches = Triangles(found.vertices, found.faces), found.patches(raw.names)
        return cls(name, mesh, None, found.repairs, patches, crossed=found.crossed)

    def remeshed(self, faces: int) -> Body:
        """The primitive meshed with about `faces` triangles; its `facets` remain those of now.

        Raises MeshError where the body is not a primitive.
        """
        if self.exact is None:
            raise MeshError(f"{self.name} is not a primitive: its exact surface is not known")
        made = self._of(self.exact, faces)
        return replace(made, degree=self.degree, robot_mesh=self.facets)

    def skinned(
        self, thickness: float, feature: float = 0.012, resolution: float | None = None
    ) -> Body:
        """The body in a skin of `thickness`, m: the surface that the skin presents.

        It is the surface at that distance from the body on which a ball of radius `feature`, m, can
        roll from outside: the skin bridges screw holes, steps, seams and notches that the ball does
        not enter. With a feature of 1.5 radii of the indenter, the indenter fits everywhere.
        `resolution`, m: length of the edges of the mesh; by default a third of the thickness or a
        fifth of the feature, at least 1/200 of the extent. `.repairs` states what is bridged and
        the error of the distance elsewhere; patches are kept. Open meshes get a skin on both sides.
        Raises MeshError.
        """
        check_real("thickness of a skin", thickness, "m", above=0.0, error=MeshError)
        check_real("feature that a skin bridges", feature, "m", above=0.0, error=MeshError)
        fine = max(min(feature / 5.0, thickness / 3.0), self.surface.scale / 200.0)
        step = fine if resolution is None else resolution
        check_real("resolution of a skin", step, "m", above=0.0, error=MeshError)
        closed = closing.closed_offset(self.surface, thickness, feature, step)
        mesh = mesh_file.Triangles(*closed)
        # open: edges at which parts of the skin touch are split
        made = self.from_triangles(f"{self.name}, skinned", mesh, open=True)
        under = self.surface.nearest(made.mesh.triangles_center).face
        patches = {
            name: np.flatnonzero(np.isin(under, rows)) for name, rows in self.patches.items()
        }
        stated = closing.statement(made.surface, self.surface, thickness)
        repairs = (*self.repairs, *made.repairs, stated)
        return replace(made, repairs=repairs, patches=patches, degree=SKINNED_DEGREE)

    @classmethod
    def sphere(cls, radius: float = 0.1, faces: int = FACES) -> Body:
        """Sphere about the origin, radius in m, as an icosphere.

        With the default of 5,120 faces, measured at 0.1 m, the errors are at most 0.01 um in the
        closest point, 0.004 um in the distance, 7e-5 deg in the normal, 6e-5 of the curvature.
        """
        return cls._of(primitives.Sphere(radius), faces)

    @classmethod
    def ellipsoid(cls, radii: ArrayLike, faces: int = FACES) -> Body:
        """Ellipsoid about the origin with semi-axes `radii` (3,) along x, y, z, in m."""
        lengths = check_vector("semi-axes of a primitive", radii, error=MeshError)
        return cls._of(primitives.Ellipsoid(tuple(lengths.tolist())), faces)

    @classmethod
    def cylinder(cls, radius: float, length: float, faces: int = FACES) -> Body:
        """Cylinder along z of `length` with flat caps, in m."""
        return cls._of(primitives.Cylinder(radius, length), faces)

    @classmethod
    def capsule(cls, radius: float, length: float, faces: int = FACES) -> Body:
        """Cylinder along z of `length` with half spheres of `radius` on its ends, in m."""
        return cls._of(primitives.Capsule(radius, length), faces)

    @classmethod
    def torus(cls, major: float, minor: float, faces: int = FACES) -> Body:
        """Torus about z: radius `major` of the ring, `minor` of the tube, in m."""
        return cls._of(primitives.Torus(major, minor), faces)

    @classmethod
    def _of(cls, exact: Exact, faces: int) -> Body:
        """A primitive, meshed with about `faces` triangles. Raises MeshError."""
        check_integer("number of faces", faces, least=1, most=MAX_FACES, error=MeshError)
        given = [(name, np.atleast_1d(values)) for name, values in vars(exact).items()]
        lengths = [(name, value) for name, values in given for value in values.tolist()]
        for name, value in lengths:
            check_real(f"{name} of a primitive", value, "m", above=0.0, error=MeshError)
        sizes = [value for _, value in lengths]
        if (slender := max(sizes) / min(sizes)) > MAX_ASPECT:
            raise MeshError(
                "the ratio of the lengths of a primitive is too large",
                value=f"{' : '.join(dict(lengths))} of {slender:.3g}",
                limit=f"{MAX_ASPECT:g}",
                remedy="correct the lengths or their units",
            )
        vertices, triangles, *seams = exact.mesh(faces)
        check_extent(vertices)
        mesh = Triangles(vertices, triangles)
        return cls(type(exact).__name__.lower(), mesh, exact, seams=seams[0] if seams else None)
