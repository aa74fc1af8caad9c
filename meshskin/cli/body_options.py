"""Options of commands that read a mesh: unit, borders, and the link of a URDF file."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..core.errors import ConfigError, MeshError
from .options import option, refuse

if TYPE_CHECKING:
    from ..geometry.body import Body
    from ..geometry.mesh.triangles import Triangles

NAMES = ("units", "open", "link", "folder", "link_mesh")
"""Names of the options."""
LIKELY = (0.02, 2.0)
"""Usual extents of bodies that carry skin, m: a fingertip to a torso. The unit is the first of m,
mm and cm in which the mesh has one, as exporters of meshes use them in this order."""
HELP = "STL, OBJ, PLY, OFF, glTF, Collada or MuJoCo (.msh) file, or a URDF file with --link"


def add(parser: Any) -> None:
    """Add the options to a parser or a group of one."""
    option(
        parser, "--units UNITS", "unit of the mesh: m, cm, mm or in; glTF, Collada and URDF files "
        "state theirs, and `check` and `init` infer that of other files from the size",
    )  # fmt: skip
    option(parser, "--open", "accept an open mesh, with borders", default=None)
    option(
        parser, "--link LINK", "link whose mesh is taken from the URDF file; with a mesh file, "
        "`calibrate` exports the map in the frame of this link",
    )  # fmt: skip
    add_folder(parser)
    option(parser, "--link-mesh KIND", "mesh of the link: visual (default) or collision")


def add_folder(parser: argparse._ActionsContainer) -> None:
    """Add --folder."""
    words = "folder that is searched for the meshes of the URDF file; may be repeated"
    option(parser, "--folder DIR", words, Path, action="append")


def triangles(path: Path, options: argparse.Namespace) -> Triangles:
    """The content of the mesh file, or of the meshes of the link. Raises MeshError."""
    from ..geometry.mesh import link_mesh, mesh_file

    _check(path, options)
    if is_mesh(path) or options.link is None:
        return mesh_file.read(path, mesh_file.unit(path, options.units))
    return link_mesh.read(path, options.link, options.folder or (), options.link_mesh or "visual")


def load(path: Path, options: argparse.Namespace) -> Body:
    """The body of the mesh file, or of the meshes of the link. Raises MeshError."""
    from ..geometry.body import Body

    _check(path, options)
    open_ = bool(options.open)
    if is_mesh(path) or options.link is None:
        return Body.load(path, units=options.units, open=open_)
    folders, kind = options.folder or (), options.link_mesh or "visual"
    return Body.from_urdf(path, options.link, folders, kind, open=open_)


def settle_units(path: Path, options: argparse.Namespace) -> str:
    """Where the unit of a mesh is from, "" where the file says it; one that is not given is told
    from the extent, and set in the options. Raises MeshError."""
    import numpy as np

    from ..geometry.mesh import mesh_file

    if options.units is not None:
        return "as asked"
    says = path.suffix.lower().lstrip(".") in (*mesh_file.METRES, "dae")
    if says or not is_mesh(path):
        return ""
    raw = mesh_file.read(path, 1.0).vertices
    raw = raw[np.isfinite(raw).all(axis=1)]
    extent = float(np.max(np.ptp(raw, axis=0))) if len(raw) else 0.0
    for unit in ("m", "mm", "cm"):
        if LIKELY[0] <= extent * mesh_file.UNITS[unit] <= LIKELY[1]:
            options.units = unit
            size = 1e3 * extent * mesh_file.UNITS[unit]
            return f"by its size: the largest extent is {size:.4g} mm then"
    raise MeshError(
        "the size does not show the unit", value=f"largest extent {extent:.4g}",
        remedy="give --units",
    )  # fmt: skip


def is_mesh(path: Path) -> bool:
    """Whether a file is a mesh by its suffix; any other one is read as a URDF file."""
    from ..geometry.mesh.mesh_file import FORMATS

    return path.suffix.lower().lstrip(".") in FORMATS


def _check(path: Path, options: argparse.Namespace) -> None:
    """Raise ConfigError for options that do not go together."""
    mesh = is_mesh(path)
    if mesh and options.link is not None and getattr(options, "export", None) is None:
        raise ConfigError(
            "--link names a link of a URDF file, or the frame of an exported map",
            value=f"--link {options.link} with {path.name}",
            remedy="give the URDF file, or leave --link out",
        )
    if mesh or options.link is None:
        names = ("folder", "link_mesh")
        refuse(options, names, "{} is for a URDF file", "give --link, too")
        if path.suffix.lower() == ".urdf":
            raise ConfigError(f"{path.name} is a URDF file", remedy="name one of its links: --link")
    elif options.units is not None:
        raise ConfigError("lengths of a URDF file are in m", value="--units", remedy="remove it")
