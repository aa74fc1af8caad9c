"""The tables of a scene file that bodies, skins and arms are made from."""

from __future__ import annotations

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
    faces: int | None = quantity("", None, above=0)

    def make(self, folder: Path) -> Body:
        body: Body = getattr(Body, self.shape)(**given(vars(self), without=("shape",)))
        return body


@dataclass(frozen=True, kw_only=True)
class _Sphere(_Primitive):
    radius: float = quantity("m", above=0.0)


@dataclass(frozen=True, kw_only=True)
class _Ellipsoid(_Primitive):
    radii: tuple[float, float, float] = quantity("m", above=0.0)


@dataclass(frozen=True, kw_only=True)
class _Capsule(_Sphere):
    length: float = quantity("m", above=0.0)


@dataclass(frozen=True, kw_only=True)
class _Torus(_Primitive):
    major: float = quantity("m", above=0.0)
    minor: float = quantity("m", above=0.0)


@dataclass(frozen=True)
class _Mesh:
    """A mesh file; with `link`, the meshes of that link of a URDF file, sought in `folders`."""

    mesh: str
    units: str | None = None
    open: bool = False
    link: str | None = None
    folders: tuple[str, ...] = ()
    link_mesh: str = "visual"

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
    count: int | None = quantity("", None, above=0)
    spacing: float | None = quantity("m", None, above=0.0)
    disc_radius: float = quantity("m", 2e-3, above=0.0)
    direction: tuple[float, ...] | None = quantity("", None)
    angle: float | None = quantity("rad", None, above=0.0, most=np.pi)
    region: Any = None
    """A table, such as {patch = "palm"}; takes precedence over `direction` and `angle`."""
    seed: int = quantity("", 0)

    def part(self) -> Region | None:
        """The part of the body that the skin covers; None: all. Raises ConfigError."""
        table, where = self.region, "skin.region"
        if table is None:
            if self.direction is None:
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
        for key in ("direction", "normal"):
            if key in table and (len(table[key]) != 3 or not np.any(table[key])):
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
    tip: str = "tool0"
    folders: tuple[str, ...] = ()
    payload: float = quantity("kg", 1.0, least=0.0, most=1e3)
    mount: tuple[float, float, float] | None = quantity("m", None)
    mount_angles: tuple[float, float, float] = quantity("rad", (0.0, 0.0, 0.0))
    base: tuple[float, float, float] = quantity("m", (0.0, 0.0, 0.0), least=-10, most=10)
    base_angles: tuple[float, float, float] = quantity("rad", (0.0, 0.0, 0.0))

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
    description: str | None = None
    contact: str | None = None
    budget: float | None = quantity("m", None, above=0.0)


def given(options: Mapping[str, Any], without: tuple[str, ...] = ()) -> dict[str, Any]:
    """The options that are not None."""
    return {k: value for k, value in options.items() if value is not None and k not in without}


def body_table(table: Mapping[str, Any]) -> Any:
    """The checked table of a body; its `make(folder)` gives the Body."""
    if "mesh" in table:
        return from_table(_Mesh, table, "body")
    shape = table.get("shape")
    if shape is None:
        raise ConfigError("[body] lacks shape or mesh", remedy=f"shape: {', '.join(_SHAPES)}")
    if str(shape) not in _SHAPES:
        raise UnknownNameError("shape", shape, _SHAPES, " in [body]")
    return from_table(_SHAPES[str(shape)], table, "body")
