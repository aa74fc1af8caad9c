"""Options of `meshskin calibrate` for the exported skin map: format, frame and parent link."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..core.errors import ConfigError
from ..core.se3 import from_rpy, transform
from . import body_options
from .options import option, real, refuse

if TYPE_CHECKING:
    from ..core.arrays import Array
    from ..estimation.calibration import Calibration

SUFFIXES = {"icub": "txt", "urdf_tactile": "urdf", "mjcf": "xml"}
"""Suffixes of the formats whose name is none."""


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    export = parser.add_argument_group("the exported skin map")
    option(
        export, "--export FILE", "write the skin map to FILE, by suffix: .txt (iCub), .csv, .urdf, "
        ".xml (MuJoCo), .npz, .yaml (ROS), .ply or .glb; a format alone, as urdf, writes skin.urdf "
        "in the folder of --out; the map is in the frame of the body: that of --link of a URDF, or "
        "else of the mesh", Path,
    )  # fmt: skip
    option(export, "--export-format FORMAT", "format of --export: urdf_tactile")
    option(
        export, "--transform X Y Z ROLL PITCH YAW", "pose (m, rad) of the mesh in the frame of "
        "--link, as the origin of a visual in a URDF: the map is written in that frame", real(),
        nargs=6,
    )  # fmt: skip
    option(export, "--parent LINK", "URDF: a link to which the link of the map is fixed")


@dataclass(frozen=True)
class Export:
    """Where a skin map is written, and in which frame."""

    path: Path
    kind: str
    """format"""
    frame: str | None
    """name of the frame; None: that of the calibration's body"""
    pose: tuple[float, ...] | None
    """of the body in that frame: x, y, z (m), roll, pitch, yaw (rad); None: they are the same"""
    parent: str | None
    whose: str
    """what the frame is, in words"""

    @classmethod
    def of(cls, options: argparse.Namespace) -> Export | None:
        """The export that the options ask for; None: none. Raises ConfigError, SkinError."""
        from ..core.atomic_io import check_writable
        from ..skin.files import FORMATS, check_format, check_frames

        if options.export is None:
            names = ("transform", "parent", "export_format")
            refuse(options, names, "{} is for an exported map", "give --export")
            return None
        path, name = options.export, str(options.export).lower()
        kind = (options.export_format or path.suffix.lstrip(".") or name).lower()
        check_format(kind)
        if name in FORMATS:
            path = options.out / f"skin.{SUFFIXES.get(name, name)}"
        check_frames(kind, options.link, options.parent)
        of_urdf = options.body is not None and not body_options.is_mesh(options.body)
        if options.transform is not None and (options.link is None or of_urdf):
            raise ConfigError(
                "--transform places a mesh in the frame of a link",
                value="a link of a URDF, whose meshes have their place" if of_urdf else "no --link",
                remedy="leave --transform out" if of_urdf else "name the link: --link NAME",
            )
        check_writable(path)
        return cls(
            path, kind, options.link, options.transform, options.parent,
            _whose(options, of_urdf),
        )  # fmt: skip

    def write(self, found: Calibration, mount: Array | None = None) -> str:
        """Write the determined taxels; returns what was written where, for the summary.

        mount: pose (4, 4), m, of the body in the frame of its link, where it was estimated.
        Nothing is written where none is determined. Raises SkinError, OutputError.
        """
        if not np.isfinite(found.positions).all(axis=1).any():
            return f"  export           {self.path} is not written: no taxel is determined"
        skin = found.skin if mount is None else found.skin.moved(mount)
        if self.pose is not None:
            skin = skin.moved(transform(from_rpy(np.array(self.pose[3:])), self.pose[:3]))
        frame = self.frame or found.frame
        skin.save(self.path, self.kind, link=frame, parent=self.parent)
        place = f"{len(skin)} taxels in the frame {frame}, {self.whose}"
        return f"  export           {self.path}: {place}"


def _whose(options: argparse.Namespace, of_urdf: bool) -> str:
    """What the frame of the map is, in words."""
    if of_urdf:
        return f"the link of {options.body.name}"
    mesh = f"the scene {options.scene}" if options.body is None else options.body.name
    if options.link is None:
        return f"that of the body of {mesh} (--link and --transform name another)"
    if options.transform is None:
        return f"taken as that of {mesh} (--transform gives its pose in the link)"
    pose = " ".join(f"{value:g}" for value in options.transform)
    return f"in which {mesh} is at {pose}"
