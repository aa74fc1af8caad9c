"""A skin: taxels (tactile elements) on a body, each with a frame; and skins of rigid modules."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core import se3
from ..core.arguments import check_integer, check_path, check_real, check_type
from ..core.arrays import Array, median_spacing
from ..core.errors import SkinError
from ..core.notebook import Card, Tabular
from ..core.value import Value
from ..geometry import region as regions
from ..geometry.body import Body
from ..geometry.mesh.mesh_file import UNITS
from . import files, lattice, module_layout, module_pose, slots, taxel_layout
from .files.table import DISC_RADIUS, SkinRows

if TYPE_CHECKING:
    import pyarrow as pa
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ..core.progress import Progress

MAX_DISTANCE = 0.05
"""Default limit on the distance from a taxel to the surface that `Skin.onto` moves it to, m: half
the radius of a forearm. A larger one means that the skin is in another frame or unit."""
MIN_COSINE = -0.999
"""Cosine between old and new normal below which `Skin.onto` chooses a new frame, about 177 degrees:
the shortest rotation between opposite normals is not determined."""
MAX_TAXELS = lattice.MAX_SITES


@dataclass(frozen=True, eq=False)
class Skin(Value, Card, Tabular):
    """n taxels in the body frame, SI units. Raises SkinError for inconsistent or repeated ids."""

    poses: Array
    """(n, 4, 4) T_b_i: z is the outward normal, x a tangent"""
    ids: NDArray[np.int64]
    """(n,) distinct integer ids of the taxels"""
    disc_radius: float = DISC_RADIUS
    """radius of the disc over which a taxel averages pressure, m"""
    sigmas: Array | None = None
    """(n,) standard deviations of the positions in space, m, of a skin that was calibrated; NaN or
    inf where not determined; None: not known"""
    frame: str | None = None
    """name of the frame that the poses are in: the link of a robot, or a mesh; None: not known"""

    def __post_init__(self) -> None:
        check_real("disc radius of a taxel", self.disc_radius, "m", above=0.0, error=SkinError)
        shape, ids = np.shape(self.poses), np.asarray(self.ids)
        if len(shape) != 3 or shape[1:] != (4, 4) or ids.shape != shape[:1]:
            raise SkinError(
                "poses and ids of a skin must be arrays of one length",
                value=f"shapes {shape} and {ids.shape}",
                limit="(n, 4, 4) and (n,)",
            )
        if not np.issubdtype(ids.dtype, np.integer) and len(ids):
            raise SkinError("ids of a skin must be integers", value=f"type {ids.dtype}")
        values, counts = np.unique(ids, return_counts=True)
        if np.any(counts > 1):
            raise SkinError(
                "ids of a skin must be distinct", value=f"{values[counts > 1][0]} twice"
            )
        if self.sigmas is not None and np.shape(self.sigmas) != ids.shape:
            raise SkinError(
                "sigmas of a skin must be one for each taxel",
                value=f"shape {np.shape(self.sigmas)}",
                limit=f"{ids.shape}",
            )

    @property
    def positions(self) -> Array:
        """(n, 3) taxel centres, m."""
        return self.poses[:, :3, 3]

    @property
    def normals(self) -> Array:
        """(n, 3) outward unit normals."""
        return self.poses[:, :3, 2]

    def __len__(self) -> int:
        return len(self.ids)

    def __repr__(self) -> str:
        return f"<Skin: {len(self)} taxels, discs of {1e3 * self.disc_radius:.4g} mm radius>"

    def facts(self) -> dict[str, str]:
        """Taxels, their distances and discs, and what is known of them, for a notebook."""
        facts = {"taxels": f"{len(self):,}"}
        if len(self) > 1:
            facts["nearest neighbours"] = f"{1e3 * self.spacing:.4g} mm apart (median)"
        facts["discs"] = f"{1e3 * self.disc_radius:.4g} mm radius"
        if self.frame is not None:
            facts["frame"] = self.frame
        if self.sigmas is not None and np.isfinite(self.sigmas).any():
            sigma = 1e3 * self.sigmas[np.isfinite(self.sigmas)]
            facts["sigma"] = f"median {np.median(sigma):.3g} mm, largest {sigma.max():.3g} mm"
        return facts

    @property
    def spacing(self) -> float:
        """Median distance of a taxel from its nearest neighbour, m; NaN for fewer than two."""
        return median_spacing(self.positions)

    def plot(self, ax: Axes | None = None, body: Body | None = None, close: bool = False) -> Figure:
        """Draw the taxels, on a body if one is given, coloured by their sigmas where known.

        ax: matplotlib axes; None: those of a new figure. close: show the skin and not the whole
        body. Returns the figure.
        """
        from ..core import drawing

        return drawing.solid(
            ax,
            close=close,
            toward=drawing.front(self.normals),
            mesh=None if body is None else body.mesh,
            points=self.positions,
            normals=self.normals if np.isfinite(self.normals).all() else None,
            values=None if self.sigmas is None else 1e3 * self.sigmas,
            label="sigma (mm)",
            radius=self.disc_radius,
            title=f"{len(self)} taxels",
        )

    def to_arrow(self) -> pa.Table:
        """One row a taxel: taxel, x, y, z (m), nx, ny, nz, qx, qy, qz, qw, and sigma (m) if known.

        A taxel without a normal has NaN there.
        """
        import pyarrow as pa

        rotation = self.poses[:, :3, :3]
        quaternions = np.full((len(self), 4), np.nan)
        whole = np.isfinite(rotation).all(axis=(1, 2))
        quaternions[whole] = se3.quaternion(rotation[whole])
        numbers = np.column_stack([self.positions, self.normals, quaternions])
        names = ("x", "y", "z", "nx", "ny", "nz", "qx", "qy", "qz", "qw")
        table = {"taxel": self.ids, **dict(zip(names, numbers.T, strict=True))}
        return pa.table(table | ({} if self.sigmas is None else {"sigma": self.sigmas}))

    @classmethod
    def cover(
        cls,
        body: Body,
        spacing: float | None = None,
        count: int | None = None,
        region: regions.Region | str | None = None,
        seed: int = 0,
        disc_radius: float = DISC_RADIUS,
        progress: Progress | None = None,
    ) -> Skin:
        """A hexagonal lattice of taxels on the smooth surface of a body.

        With `spacing` (m, mean distance between nearest neighbours) alone the region is filled.
        With `count` alone the spacing follows from the region's area. With both, the `count` sites
        nearest to the region's centre are kept. `region` is the name of one of the body's patches
        or a region of geometry/region.py, by default the whole surface; what another part of the
        body covers is left out. `seed` sets the rotation and the offset of the lattice.
        progress("cover", done, total): called after each of its steps. Raises SkinError where discs
        would overlap or too few sites fit the region.

        >>> ms.Skin.cover(ms.Body.sphere(radius=0.1), spacing=5e-3, count=60).positions.shape
        (60, 3)
        """
        check_type(Body, body, "the body of a skin")
        if spacing is None and count is None:
            raise SkinError("a skin needs a spacing or a count", remedy="give one or both")
        if count is not None:
            most = MAX_TAXELS
            count = check_integer("number of taxels", count, least=1, most=most, error=SkinError)
        check_real("disc radius of a taxel", disc_radius, "m", above=0.0, error=SkinError)
        region = regions.exposed(body, region)
        sites = taxel_layout.sites(body, region, spacing, count, disc_radius, seed, progress)
        rotation = se3.orthonormal_basis(sites.at.normal, sites.tangent)
        return cls(se3.transform(rotation, sites.at.point), np.arange(len(sites)), disc_radius)

    @staticmethod
    def modules(
        body: Body,
        count: int | None = None,
        spacing: float = module_layout.SPACING,
        region: regions.Region | str | None = None,
        seed: int = 0,
        disc_radius: float = DISC_RADIUS,
    ) -> Modules:
        """Rigid triangular modules side by side on a body; their taxels are `Modules.skin`.

        As many as fit the region, or the `count` nearest to its centre. `spacing` (m) is the
        distance between the centres of neighbours. A module belongs to a region that contains the
        closest points of all its taxels. `seed` sets the rotation and the offset of the layout.
        Raises SkinError where modules would overlap on a plane, or where too few fit.
        """
        check_type(Body, body, "the body of a skin")
        region = regions.exposed(body, region)
        poses = module_layout.module_poses(body, count, spacing, region, seed)
        return Modules(poses, np.arange(len(poses)), disc_radius)

    @classmethod
    def load(cls, path: str | Path, part: str | None = None, units: str = "m") -> Skin:
        """A skin from a file, whose format is recognized by its content.

        Formats: CSV, iCub position files and layouts, iDynTree transforms, URDF (frames, or sensors
        of urdf_tactile), and MJCF, NPZ, YAML, PLY and GLB as `save` writes them. `part` chooses one
        of the skins of a URDF or MJCF. `units` are those of the positions in the file: "m", "cm",
        "mm" or "in". Rows that the file declares not to be taxels are skipped. The rotation of a
        taxel whose normal is not in the file is NaN; `onto` sets it. Raises SkinError.
        """
        if units not in UNITS:
            raise SkinError("unknown unit", value=repr(units), limit=f"one of {[*UNITS]}")
        table = files.read(path, part)
        table = table.take(table.is_taxel())
        table = replace(table, positions=UNITS[units] * table.positions)
        poses = table.poses(Path(path).name)
        return cls(poses, table.ids, table.disc_radius, table.sigmas, table.frame)

    def save(
        self,
        path: str | Path,
        format: str | None = None,
        *,
        link: str | None = None,
        parent: str | None = None,
    ) -> None:
        """Write the skin atomically, in the format of the suffix of `path`, or in `format`.

        Formats: "csv", "txt" or "icub" (position file), "urdf" (a link and a fixed joint a taxel),
        "urdf_tactile" (sensor with taxels), "xml" or "mjcf" (MuJoCo sites with touch sensors),
        "npz" (poses (n, 3, 4)), "yaml" (static transforms of ROS), and for viewers "ply" and "glb".
        Every file names the frame of its poses: `link`, by default that of the skin, or else the
        file's stem; frames of taxels are `<link>_skin_<id>`. Sigmas are written where known.
        `parent`: of the two URDF formats, a link to which `link` is fixed, at its origin.
        Raises SkinError, OutputError.
        """
        path = check_path("a skin file", path, error=SkinError)
        kind = (format or path.suffix.lstrip(".")).lower()
        frame = link or self.frame or path.stem
        rows = SkinRows(self.poses, self.ids, self.disc_radius, frame, self.sigmas, parent)
        files.write(path, kind, rows)

    def moved(self, T_b_a: ArrayLike, frame: str | None = None) -> Skin:
        """This skin, given in frame a, in another frame b; `T_b_a` (4, 4) is the pose of a.

        `frame`: name of b.

        Skin files are in the frame of the robot's link, mesh files mostly in one of their own. The
        origin of the link's visual in the URDF is T_link_mesh, the pose of the mesh in the link:
        its inverse moves a skin into the frame of the mesh. Raises SkinError for a matrix that is
        not a rigid transform.
        """
        if not se3.is_rigid(T_b_a):
            raise SkinError(
                "T_b_a must be a rigid transform",
                value=f"shape {np.shape(T_b_a)}" if np.shape(T_b_a) != (4, 4) else None,
                limit="(4, 4), orthonormal rotation without reflection, last row 0 0 0 1",
            )
        return replace(self, poses=np.asarray(T_b_a, dtype=float) @ self.poses, frame=frame)

    def onto(self, body: Body, within: float = MAX_DISTANCE) -> Skin:
        """The skin moved onto a body: to the closest points of its surface, with its normals.

        Each frame is rotated by the shortest rotation to its new normal. A frame that is NaN, or
        whose normal is opposite to the new one, is set by `se3.orthonormal_basis`. Skin and body
        are in one frame. Raises SkinError where a taxel is farther than `within` (m) from it.
        """
        check_type(Body, body, "what a skin is moved onto")
        at = body.closest(self.positions)
        distance = np.abs(at.distance)
        if len(self) and distance.max() > check_real("within", within, "m", error=SkinError):
            worst = int(np.argmax(distance))
            raise SkinError(
                f"taxel {self.ids[worst]} is too far from the surface of {body.name}",
                value=f"{1e3 * distance[worst]:.4g} mm",
                limit=f"{1e3 * within:g} mm",
                remedy="give the skin in the body's frame, its file's units (Skin.load(path, "
                "units='mm')), or a larger `within`",
            )
        rotation = se3.orthonormal_basis(at.normal)
        cosine = np.einsum("ij,ij->i", self.normals, at.normal)
        rows = np.flatnonzero(cosine > MIN_COSINE)  # False for NaN
        step = se3.shortest_rotation(self.normals[rows], at.normal[rows])
        rotation[rows] = step @ self.poses[rows, :3, :3]
        return replace(self, poses=se3.transform(rotation, at.point))


@dataclass(frozen=True, eq=False)
class Modules(Value):
    """m rigid triangular modules of ten taxels in the body frame."""

    poses: Array
    """(m, 4, 4) T_b_module: origin at the centre of the triangle (slot 3), z outward"""
    numbers: NDArray[np.int64]
    """(m,) module numbers: the id of a taxel is 12 * number + slot"""
    disc_radius: float = DISC_RADIUS
    """radius of the disc over which a taxel averages pressure, m"""

    def __len__(self) -> int:
        return len(self.numbers)

    def __repr__(self) -> str:
        return f"<Modules: {len(self)}, {len(slots.TAXELS)} taxels each>"

    @cached_property
    def skin(self) -> Skin:
        """The taxels, ten a module, with the orientation of their module."""
        offsets = se3.transform(np.eye(3), module_pose.TAXEL_OFFSETS)
        poses = (self.poses[:, None] @ offsets).reshape(-1, 4, 4)
        ids = np.add.outer(slots.PER_MODULE * self.numbers, slots.TAXELS).ravel()
        return Skin(poses, ids, self.disc_radius)

    @property
    def corners(self) -> Array:
        """(m, 3, 3) corners of the triangles, counter-clockwise seen from outside, m."""
        return module_pose.corners(self.poses)

    @classmethod
    def of(cls, skin: Skin, tolerance: float = 1e-3) -> Modules:
        """The modules of a skin, by a least-squares fit to the positions of their ten taxels.

        Normals are not used: a skin whose file has none, or wrong ones, gets those of its modules.
        Raises SkinError where a module is not complete, or a taxel is more than `tolerance` (m)
        from its place in the module.
        """
        numbers = np.unique(slots.module(skin.ids))
        if not slots.is_modular(skin.ids):
            raise SkinError(
                "the skin does not consist of modules with ten taxels", limit="12 * module + slot"
            )
        order = np.argsort(skin.ids)
        points = skin.positions[order].reshape(len(numbers), len(slots.TAXELS), 3)
        poses = np.array([se3.align(module_pose.TAXEL_OFFSETS, own) for own in points])
        modules = cls(poses, numbers, skin.disc_radius)
        off = np.linalg.norm(modules.skin.positions.reshape(points.shape) - points, axis=2)
        worst = int(np.argmax(off.max(axis=1)))
        if off[worst].max() > tolerance:
            raise SkinError(
                f"taxels of module {numbers[worst]} deviate from those of a module",
                value=f"{1e3 * off[worst].max():.2g} mm",
                limit=f"{1e3 * tolerance:g} mm",
            )
        return modules
