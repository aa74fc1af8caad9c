"""The tables of a scene file that bodies, skins and arms are made from."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..core.arrays import Array
from ..core.config import from_table, quantity
from ..core.errors import ConfigError, UnknownNameError
from ..core.se3 import exp_so3, transform
from ..geometry.body import Body
from ..geometry.region import Cap, Disc, Faces, HalfSpace, Patch, Region
from ..skin.skin import Skin


@dataclass(frozen=True, kw_only=True)
class _Primitive:
    shape: str
    """Kind of body."""
    faces: int | None = quantity("", None, above=0)
    """About how many triangles the mesh has; None: 5,120."""

    def make(self, folder: Path) -> Body:
        body: Body = getattr(Body, self.shape)(**given(vars(self), without=("shape",)))
        return body


@dataclass(frozen=True, kw_only=True)
class _Sphere(_Primitive):
    radius: float = quantity("m", above=0.0)
    """Radius of the sphere, or of the capsule's ends."""


@dataclass(frozen=True, kw_only=True)
class _Ellipsoid(_Primitive):
    radii: tuple[float, float, float] = quantity("m", above=0.0)
    """Semi-axes along x, y and z."""


@dataclass(frozen=True, kw_only=True)
class _Capsule(_Sphere):
    length: float = quantity("m", above=0.0)
    """Length between the centres of the ends, along z."""


@dataclass(frozen=True, kw_only=True)
class _Torus(_Primitive):
    major: float = quantity("m", above=0.0)
    """Radius of the ring, about z."""
    minor: float = quantity("m", above=0.0)
    """Radius of the tube."""


@dataclass(frozen=True)
class _Mesh:
    """A mesh file; with `link`, the meshes of that link of a URDF file, sought in `folders`."""

    mesh: str
    """A mesh file, or a URDF file with `link`."""
    units: str | None = None
    """Unit of the mesh, "m", "cm", "mm" or "in"; glTF and Collada files have their own."""
    open: bool = False
    """Whether a mesh with borders is accepted."""
    link: str | None = None
    """Link of the URDF file whose meshes are the body."""
    folders: tuple[str, ...] = ()
    """Folders that are searched for the link's meshes, too."""
    link_mesh: str = "visual"
    """"visual" or "collision"."""

    def make(self, folder: Path) -> Body:
        if self.link is not None:
            folders = [folder / name for name in self.folders]
            return Body.from_urdf(folder / self.mesh, self.link, folders, self.link_mesh, self.open)
        return Body.load(folder / self.mesh, units=self.units, open=self.open)


_SHAPES: dict[str, type] = {
    "sphere": _Sphere,
    "ellipsoid": _Ellipsoid,
    "capsule": _Capsule,
    "torus": _Torus,
}
_REGIONS: dict[str, type] = {
    "patch": Patch,
    "direction": Cap,
    "point": Disc,
    "normal": HalfSpace,
    "faces": Faces,
}
"""Kinds of a skin's region, by the key that only each of them has."""


@dataclass(frozen=True)
class SkinTable:
    """[skin]: a file, or taxels on a lattice."""

    file: str | None = None
    """A skin file; the other keys are then not used."""
    count: int | None = quantity("", None, above=0)
    """Number of taxels, nearest to the region's centre; None: as many as the region holds."""
    spacing: float | None = quantity("m", None, above=0.0)
    """Distance of neighbouring taxels; None: it follows from `count`."""
    disc_radius: float = quantity("m", 2e-3, above=0.0)
    """Radius of the disc over which a taxel reads the mean pressure."""
    direction: tuple[float, ...] | None = quantity("", None)
    """Middle of the skin, seen from the body's centre; need not be a unit vector."""
    angle: float | None = quantity("rad", None, above=0.0, most=np.pi)
    """Largest angle from `direction`; None: no limit."""
    region: Any = None
    """A table, such as {patch = "palm"}; takes precedence over `direction` and `angle`."""
    seed: int = quantity("", 0)
    """Seed of the lattice."""

    def part(self) -> Region | None:
        """The part of the body that the skin covers; None: all. Raises ConfigError."""
        table, where = self.region, "skin.region"
        if table is None:
            if self.direction is None:
                if self.angle is not None:
                    raise ConfigError(
                        "skin.angle needs the direction from which it counts",
                        value="no skin.direction",
                        remedy="write direction = [0, 0, 1], or leave the angle out",
                    )
                return None
            where = "skin"
            table = given({"direction": list(self.direction), "angle_rad": self.angle})
        if not isinstance(table, Mapping):
            remedy = f'write region = {{patch = "{table}"}}' if isinstance(table, str) else None
            raise ConfigError("skin.region must be a table", value=repr(table), remedy=remedy)
        kinds = [k for k in _REGIONS if any(key == k or key.startswith(f"{k}_") for key in table)]
        if len(kinds) != 1:
            raise ConfigError(
                "skin.region must have the key of one kind of region",
                value=" and ".join(kinds) or "none",
                limit=f"one of {', '.join(_REGIONS)}",
            )
        for key in {"direction", "normal"} & set(table):
            vector = np.atleast_1d(np.array(table[key], dtype=object))
            if vector.shape != (3,) or not vector.any():
                raise ConfigError(
                    f"{where}.{key} must be a nonzero vector of 3 numbers", value=table[key]
                )
        region: Region = from_table(_REGIONS[kinds[0]], table, where)
        return region

    def make(self, body: Body, folder: Path) -> Skin:
        """The skin on `body`; a file is relative to `folder`."""
        if self.file is not None:
            return Skin.load(folder / self.file)
        return Skin.cover(
            body,
            spacing=self.spacing,
            count=self.count,
            region=self.part(),
            seed=self.seed,
            disc_radius=self.disc_radius,
        )


@dataclass(frozen=True)
class ArmTable:
    """[arm]: the URDF file, the payload and the mount, and the pose of the base."""

    urdf: str = "puma560.urdf"
    """The robot, a file beside the scene or among the shipped ones."""
    tip: str = "tool0"
    """Link that carries the body, or the indenter."""
    folders: tuple[str, ...] = ()
    """Folders that are searched for the links' meshes, too."""
    payload: float = quantity("kg", 1.0, least=0.0, most=1e3)
    """Mass of the body, spread evenly over its volume."""
    mount: tuple[float, float, float] | None = quantity("m", None)
    """Position of the body in the tip's frame; None: the skin faces along the tip's z axis."""
    mount_angles: tuple[float, float, float] = quantity("rad", (0.0, 0.0, 0.0))
    """Rotation vector of the body in the tip's frame; used with `mount`."""
    base: tuple[float, float, float] = quantity("m", (0.0, 0.0, 0.0), least=-10, most=10)
    """Position of the arm's root link in the world."""
    base_angles: tuple[float, float, float] = quantity("rad", (0.0, 0.0, 0.0))
    """Rotation vector of the arm's root link in the world."""

    def mount_pose(self) -> Array | None:
        """T_tip_body (4, 4) from a position and a rotation vector; None: the scene's default."""
        if self.mount is None:
            return None
        return transform(exp_so3(self.mount_angles), self.mount)

    def base_pose(self) -> Array:
        """T_w_base (4, 4) from a position and a rotation vector."""
        return transform(exp_so3(self.base_angles), self.base)


@dataclass(frozen=True)
class SceneTable:
    """The top-level keys with one value: text, and the error budget."""

    name: str | None = None
    """Name in reports and metrics; None: that of the file."""
    description: str | None = None
    """One line about the scene."""
    contact: str | None = None
    """Contact model: "hertz", "elliptic", "layered", or "auto" (the default), the first of them
    that holds at every taxel at which any of them does."""
    budget: float | None = quantity("m", None, above=0.0)
    """Taxel error that omitted effects may cause; it decides which effects are on."""


def given(options: Mapping[str, Any], without: tuple[str, ...] = ()) -> dict[str, Any]:
    """The options that are not None."""
    return {k: value for k, value in options.items() if value is not None and k not in without}


def body_table(table: Mapping[str, Any]) -> Any:
    """The checked table of a body; its `make(folder)` gives the Body."""
    if "file" in table:  # as in [skin]
        remedy = f"write mesh = {json.dumps(str(table['file']))}"
        raise ConfigError("unknown key 'file' in [body]", remedy=remedy)
    if "mesh" in table:
        return from_table(_Mesh, table, "body")
    shape = table.get("shape")
    if shape is None:
        remedy = f'write mesh = "FILE", or shape = one of {", ".join(_SHAPES)}'
        raise ConfigError("[body] lacks shape or mesh", remedy=remedy)
    if str(shape) not in _SHAPES:
        raise UnknownNameError("shape", shape, _SHAPES, " in [body]")
    return from_table(_SHAPES[str(shape)], table, "body")
