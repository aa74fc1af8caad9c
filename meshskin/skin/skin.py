"""A skin: taxels (tactile elements) on a body, each with a frame."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core import se3
from ..core.arguments import check_integer, check_real, check_type
from ..core.errors import SkinError
from ..core.provenance import random_stream
from ..geometry import region as regions
from ..geometry.body import Body
from ..geometry.mesh.mesh_file import UNITS
from . import lattice, modules

Array = NDArray[np.float64]

REGULAR = (0.01, 0.03)
"""mean and scatter of the nearest neighbours' distance within which a lattice needs no relaxing"""
CLOSER = 0.96
"""spacing of a large relaxed lattice, relative to the perfect one of as many sites on a plane"""
GROWN = 1500
"""sites that are grown one by one; a lattice of more is grown coarse, and halved"""
FARTHEST = 0.05
"""m, from the body's surface to a taxel that is put on it, at most, unless asked for"""
HEADLONG = -0.999
"""cosine between old and new normal below which a frame does not say how to turn it"""
MOST = 1_000_000
"""taxels of a lattice"""
TRIES = 3
"""lattices grown again, each wider by what the last one missed"""


@dataclass(frozen=True, eq=False)
class Skin:
    """n taxels in the body frame, SI units."""

    poses: Array
    """(n, 4, 4) T_b_i: z the outward normal, x a tangent transported over the surface"""
    ids: NDArray[np.int64]
    """(n,) names of the taxels"""
    disc_radius: float = 2e-3
    """radius in m of the disc over which a taxel averages pressure"""

    def __post_init__(self) -> None:
        check_real("radius of a taxel's disc", self.disc_radius, error=SkinError)
        if not self.disc_radius > 0:
            raise SkinError(
                "radius of a taxel's disc", value=f"{1e3 * self.disc_radius:g} mm", limit="above 0"
            )
        shape = np.shape(self.poses)
        if len(shape) != 3 or shape[1:] != (4, 4) or np.shape(self.ids) != shape[:1]:
            raise SkinError(
                "a skin's poses and ids",
                value=f"shapes {shape} and {np.shape(self.ids)}",
                limit="(n, 4, 4) and (n,)",
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
        disc_radius: float = 2e-3,
    ) -> Skin:
        """A hexagonal lattice of taxels on a body's smooth surface.

        With `spacing` (m, mean distance of nearest neighbours) alone the region is filled; with
        `count` alone the spacing follows from the region's area; with both, the `count` sites
        nearest to the region's centre are kept. `region`: the name of one of the body's patches, or
        a part of the surface as of region.py; without it, all. `seed` turns and shifts the lattice.
        Raises SkinError where the discs would overlap or the region is too small.
        """
        check_type(Body, body, "the body of a skin")
        if spacing is None and count is None:
            raise SkinError("a layout without spacing and count", remedy="give one or both")
        if count is not None:
            count = check_integer("number of taxels", count, least=1, most=MOST, error=SkinError)
        check_real("radius of a taxel's disc", disc_radius, error=SkinError)
        region = regions.of(region)
        if spacing is None:
            assert count is not None
            sites = _sites_by_count(body, region, count, disc_radius, seed)
        else:
            check_real("spacing of taxels", spacing, error=SkinError)
            _check_spacing(body, spacing, disc_radius)
            sites = _sites(body, region, spacing, seed, count)
        if count is not None:
            if len(sites) < count:
                remedy = "a smaller spacing or a larger region"
                limit = f"the {len(sites)} that fit the region"
                raise SkinError("number of taxels", value=count, limit=limit, remedy=remedy)
            sites = sites.take(np.argsort(sites.way, kind="stable")[:count])
        rotation = se3.orthonormal_basis(sites.at.normal, sites.tangent)
        return cls(se3.transform(rotation, sites.at.point), np.arange(len(sites)), disc_radius)

    @staticmethod
    def modules(
        body: Body,
        count: int | None = None,
        spacing: float = modules.SPACING,
        region: regions.Region | str | None = None,
        seed: int = 0,
        disc_radius: float = 2e-3,
    ) -> modules.Modules:
        """Rigid triangular modules on a body, and by `.skin` their taxels: see `modules.lay`."""
        return modules.lay(body, count, spacing, region, seed, disc_radius)

    @classmethod
    def load(cls, path: str | Path, part: str | None = None, units: str = "m") -> Skin:
        """A skin from a file, recognised by its content; `part` chooses one of a URDF's skins.

        `units`: those of the file's positions, "m", "cm", "mm" or "in". Formats: CSV, iCub position
        files and layouts, iDynTree transforms, URDF, and PLY and GLB as saved. Rows that the file
        itself says are no taxels are left out. A taxel without a normal in the file has a rotation
        of NaN: `skin.onto(body)` gives it the body's. Raises SkinError.
        """
        from . import files

        if units not in UNITS:
            raise SkinError("units of a skin file", value=repr(units), limit=f"one of {[*UNITS]}")
        table = files.read(Path(path), part)
        table = table.take(table.is_taxel())
        table = replace(table, positions=UNITS[units] * table.positions)
        return cls(table.poses(Path(path).name), table.ids, table.disc_radius)

    def save(self, path: str | Path, format: str | None = None) -> None:
        """Write the skin to a file in one stroke, by its suffix or as `format`.

        "csv", "txt" or "icub" (position file), "urdf", "ply" and "glb" (to look at). Raises
        SkinError, OutputError.
        """
        from . import files

        kind = (format or Path(path).suffix.lstrip(".")).lower()
        files.write(Path(path), kind, self.poses, self.ids, self.disc_radius)

    def moved(self, T_b_a: ArrayLike) -> Skin:
        """The same taxels in another frame b: the skin is given in a, `T_b_a` (4, 4) the pose of a.

        Skin files are in the frame of the robot's link, mesh files mostly in their own: the origin
        of the link's visual in the URDF is the mesh's pose in the link's frame, T_link_mesh; the
        skin is moved by its inverse.
        """
        return replace(self, poses=np.asarray(T_b_a, dtype=float).reshape(4, 4) @ self.poses)

    def onto(self, body: Body, within: float = FARTHEST) -> Skin:
        """The skin put on a body: moved to the closest points of its surface, upright there.

        A file's normals may be missing, or one constant; the surface's take their place. Each frame
        turns the shortest way to its new normal, so that its spin is kept; where there was none, or
        it stood on its head, a fixed convention sets it. Both are in the body frame. Raises
        SkinError where a taxel is farther than `within`, m, from the surface.
        """
        at = body.closest(self.positions)
        off = np.abs(at.distance)
        if len(self) and off.max() > within:
            worst = int(np.argmax(off))
            raise SkinError(
                f"taxel {self.ids[worst]} off the surface of {body.name} by",
                value=f"{1e3 * off[worst]:.4g} mm",
                limit=f"{1e3 * within:g} mm",
                remedy="the skin in the body's frame, its file's units (Skin.load(path, "
                "units='mm')), or a larger `within`",
            )
        rotation = se3.orthonormal_basis(at.normal)
        cosine = np.einsum("ij,ij->i", self.normals, at.normal)
        turned = np.flatnonzero(cosine > HEADLONG)  # not where a rotation is NaN
        step = se3.shortest_rotation(self.normals[turned], at.normal[turned])
        rotation[turned] = step @ self.poses[turned, :3, :3]
        return replace(self, poses=se3.transform(rotation, at.point))


def _check_spacing(body: Body, spacing: float, disc_radius: float) -> None:
    if not (np.isfinite(spacing) and 2.0 * disc_radius <= spacing):
        raise SkinError(
            "spacing of taxels",
            value=f"{spacing * 1e3:g} mm",
            limit=f">= {2e3 * disc_radius:g} mm, the discs' diameter",
            remedy="a larger spacing or a smaller disc_radius",
        )
    if spacing > body.surface.scale:
        raise SkinError(
            "spacing of taxels",
            value=f"{spacing * 1e3:g} mm",
            limit=f"the body's {body.surface.scale * 1e3:g} mm",
            remedy="lengths are in m",
        )


def _sites(
    body: Body, region: regions.Region, spacing: float, seed: int, count: int | None
) -> lattice.Lattice:
    """Lattice sites at a spacing (m), relaxed until their mean distance is that spacing.

    Their way is from the region's centre.
    """
    first = lattice.first_site(body, region, spacing, random_stream(seed, "skin layout"))
    halvings = 0 if count is not None else _halvings(regions.area(body, region), spacing)

    def lay(aim: float) -> lattice.Lattice:
        if count is None:
            return lattice.fill(body, region, aim, first, halvings)
        margin = round(4.0 * np.sqrt(count))  # two rings more than needed, trimmed later
        return lattice.grow(body, region, aim, first, count + margin)

    aim = spacing / CLOSER if halvings else spacing
    for _ in range(1 + TRIES):  # sites that cannot close up evenly come nearer than they should
        sites = lay(aim)
        if sites.spacing()[1] > REGULAR[1]:
            sites = lattice.relax(body, region, sites, aim)
        mean, _ = sites.spacing()
        if len(sites) < 3 or abs(mean / spacing - 1) < REGULAR[0]:
            break
        aim *= spacing / mean
    return _from_centre(body, region, sites, spacing)


def _sites_by_count(
    body: Body, region: regions.Region, count: int, disc_radius: float, seed: int
) -> lattice.Lattice:
    """At least `count` sites: of a lattice too irregular to be trimmed at its end, just so many."""
    area = regions.area(body, region)
    spacing = float(np.sqrt(area / (lattice.ROW * count)))
    if count > GROWN:
        spacing *= 0.99 * CLOSER  # rather a few too many, to be thinned, than to begin again
    for _ in range(8):
        spacing = min(spacing, body.surface.scale)
        _check_spacing(body, spacing, disc_radius)
        first = lattice.first_site(body, region, spacing, random_stream(seed, "skin layout"))
        sites = lattice.fill(body, region, spacing, first, _halvings(area, spacing))
        if sites.spacing()[1] > REGULAR[1]:
            sites = lattice.relax(body, region, sites, spacing)
            if len(sites) > count > 2:
                sites = lattice.thin(body, region, sites, count)
        if len(sites) >= count:
            break
        spacing *= 0.995 * float(np.sqrt(len(sites) / count))
    return _from_centre(body, region, sites, spacing)


def _halvings(area: float, spacing: float) -> int:
    """How often a lattice on an area (m^2) is halved to reach a spacing (m)."""
    sites = area / (lattice.ROW * spacing**2)
    return max(0, int(np.ceil(np.log(max(sites, 1.0) / GROWN) / np.log(4.0))))


def _from_centre(
    body: Body, region: regions.Region, sites: lattice.Lattice, spacing: float
) -> lattice.Lattice:
    """The same sites, their way from the region's centre."""
    way = regions.arc_length(region.centre(body), sites.at)
    return replace(sites, way=np.maximum(way, sites.way - spacing))
