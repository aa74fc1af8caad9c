"""A skin: taxels (tactile elements) on a body, each with a frame; and skins of rigid modules."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core import se3
from ..core.arguments import check_integer, check_real, check_type
from ..core.arrays import Array
from ..core.errors import SkinError
from ..geometry import region as regions
from ..geometry.body import Body
from ..geometry.mesh.mesh_file import UNITS
from . import files, module_layout, module_pose, slots, taxel_layout
from .files.table import DISC_RADIUS

MAX_DISTANCE = 0.05
"""Default limit on the distance from a taxel to the surface that `Skin.onto` moves it to, m: half
the radius of a forearm. A larger one means that the skin is in another frame or unit."""
MIN_COSINE = -0.999
"""Cosine between old and new normal below which `Skin.onto` sets a frame anew, about 177 degrees:
the shortest rotation between opposite normals is not determined."""
MAX_TAXELS = 1_000_000
"""Largest number of taxels of one layout: more are a wrong unit, and exhaust the memory."""


@dataclass(frozen=True, eq=False)
class Skin:
    """n taxels in the body frame, SI units. Raises SkinError for inconsistent or repeated ids."""

    poses: Array
    """(n, 4, 4) T_b_i: z is the outward normal, x a tangent"""
    ids: NDArray[np.int64]
    """(n,) distinct integer ids of the taxels"""
    disc_radius: float = DISC_RADIUS
    """radius of the disc over which a taxel averages pressure, m"""

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

    @classmethod
    def cover(
        cls,
        body: Body,
        spacing: float | None = None,
        count: int | None = None,
        region: regions.Region | str | None = None,
        seed: int = 0,
        disc_radius: float = DISC_RADIUS,
    ) -> Skin:
        """A hexagonal lattice of taxels on the smooth surface of a body.

        With `spacing` (m, mean distance between nearest neighbours) alone the region is filled.
        With `count` alone the spacing follows from the region's area. With both, the `count` sites
        nearest to the region's centre are kept. `region` is the name of one of the body's patches
        or a region of geometry/region.py, by default the whole surface. `seed` sets the rotation
        and the offset of the lattice. Raises SkinError where discs would overlap or too few sites
        fit the region.
        """
        check_type(Body, body, "the body of a skin")
        if spacing is None and count is None:
            raise SkinError("a layout without spacing and count", remedy="give one or both")
        if count is not None:
            count = check_integer(
                "number of taxels", count, least=1, most=MAX_TAXELS, error=SkinError
            )
        check_real("disc radius of a taxel", disc_radius, "m", above=0.0, error=SkinError)
        sites = taxel_layout.sites(
            body, regions.as_region(region), spacing, count, disc_radius, seed
        )
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
        poses = module_layout.module_poses(body, count, spacing, regions.as_region(region), seed)
        return Modules(poses, np.arange(len(poses)), disc_radius)

    @classmethod
    def load(cls, path: str | Path, part: str | None = None, units: str = "m") -> Skin:
        """A skin from a file, whose format is recognized by its content.

        Formats: CSV, iCub position files and layouts, iDynTree transforms, URDF (frames, or sensors
        of urdf_tactile), and MJCF, NPZ, YAML, PLY and GLB as `save` writes them. `part` chooses one
        of the skins of a URDF or MJCF. `units` are those of the
        positions in the file: "m", "cm", "mm" or "in". Rows that the file declares not to be taxels
        are skipped. The rotation of a taxel whose normal is not in the file is NaN; `onto` sets it.
        Raises SkinError.
        """
        if units not in UNITS:
            raise SkinError("units of a skin file", value=repr(units), limit=f"one of {[*UNITS]}")
        table = files.read(Path(path), part)
        table = table.take(table.is_taxel())
        table = replace(table, positions=UNITS[units] * table.positions)
        return cls(table.poses(Path(path).name), table.ids, table.disc_radius)

    def save(self, path: str | Path, format: str | None = None) -> None:
        """Write the skin atomically, in the format of the suffix of `path`, or in `format`.

        Formats: "csv", "txt" or "icub" (position file), "urdf" (a link and a fixed joint a taxel),
        "urdf_tactile" (sensor with taxels), "xml" or "mjcf" (MuJoCo sites with touch sensors),
        "npz" (poses (n, 3, 4)), "yaml" (static transforms of ROS), and for viewers "ply" and "glb".
        Frames are named after the file's stem: `<stem>_skin_<id>` on the link or body `<stem>`.
        Raises SkinError, OutputError.
        """
        kind = (format or Path(path).suffix.lstrip(".")).lower()
        files.write(Path(path), kind, self.poses, self.ids, self.disc_radius)

    def moved(self, T_b_a: ArrayLike) -> Skin:
        """The same taxels in another frame b; the skin is given in a, `T_b_a` (4, 4) is a's pose.

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
        return replace(self, poses=np.asarray(T_b_a, dtype=float) @ self.poses)

    def onto(self, body: Body, within: float = MAX_DISTANCE) -> Skin:
        """The skin moved onto a body: to the closest points of its surface, with its normals.

        Each frame is rotated by the shortest rotation to its new normal. A frame that is NaN, or
        whose normal is opposite to the new one, is set by `se3.orthonormal_basis`. Skin and body
        are in one frame. Raises SkinError where a taxel is farther than `within` (m) from the
        surface.
        """
        at = body.closest(self.positions)
        distance = np.abs(at.distance)
        if len(self) and distance.max() > within:
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
class Modules:
    """m rigid triangular modules of ten taxels in the body frame."""

    poses: Array
    """(m, 4, 4) T_b_module: origin at the centre of the triangle (slot 3), z outward"""
    numbers: NDArray[np.int64]
    """(m,) module numbers: the id of a taxel is 12 * number + slot"""
    disc_radius: float = DISC_RADIUS
    """radius of the disc over which a taxel averages pressure, m"""

    def __len__(self) -> int:
        return len(self.numbers)

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
                "a skin that is not of modules with ten taxels", limit="12 * module + slot"
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
