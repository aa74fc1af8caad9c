"""The tables of a scene file that bodies, skins and arms are made from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..core.config import check_fields, from_table, quantity
from ..core.errors import ConfigError, UnknownNameError
from ..core.se3 import Array, exp_so3, transform
from ..geometry.body import Body
from ..geometry.region import Cap, Disc, Faces, HalfSpace, Patch, Region
from ..skin.skin import Skin


@dataclass(frozen=True)
class _Sphere:
    shape: str
    radius: float = quantity("m", above=0.0)
    faces: int | None = quantity("", None, above=0)

    def make(self, folder: Path) -> Body:
        check_fields(self)
        return Body.sphere(self.radius, **given(faces=self.faces))


@dataclass(frozen=True)
class _Ellipsoid:
    shape: str
    radii: tuple[float, float, float] = quantity("m", above=0.0)
    faces: int | None = quantity("", None, above=0)

    def make(self, folder: Path) -> Body:
        check_fields(self)
        return Body.ellipsoid(self.radii, **given(faces=self.faces))


@dataclass(frozen=True)
class _Capsule:
    shape: str
    radius: float = quantity("m", above=0.0)
    length: float = quantity("m", above=0.0)
    faces: int | None = quantity("", None, above=0)

    def make(self, folder: Path) -> Body:
        check_fields(self)
        return Body.capsule(self.radius, self.length, **given(faces=self.faces))


@dataclass(frozen=True)
class _Torus:
    shape: str
    major: float = quantity("m", above=0.0)
    minor: float = quantity("m", above=0.0)
    faces: int | None = quantity("", None, above=0)

    def make(self, folder: Path) -> Body:
        check_fields(self)
        return Body.torus(self.major, self.minor, **given(faces=self.faces))


@dataclass(frozen=True)
class _Mesh:
    mesh: str
    units: str | None = None
    open: bool = False

    def make(self, folder: Path) -> Body:
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
"""Kinds of a skin's region, by the key that each needs."""


@dataclass(frozen=True)
class SkinTable:
    file: str | None = None
    count: int | None = quantity("", None, above=0)
    spacing: float | None = quantity("m", None, above=0.0)
    disc_radius: float = quantity("m", 2e-3, above=0.0)
    direction: tuple[float, ...] | None = quantity("", None)
    angle: float | None = quantity("rad", None, above=0.0, most=np.pi)
    region: Any = None
    """a table, as {patch = "palm"}; goes before `direction` and `angle`"""
    seed: int = quantity("", 0)

    def part(self) -> Region | None:
        """The part of the body that the skin is laid on. Raises ConfigError."""
        table, where = self.region, "skin.region"
        if table is None:
            if self.direction is None:
                return None
            table, where = {"direction": list(self.direction)}, "skin"
            table |= given(angle_rad=self.angle)
        if not isinstance(table, Mapping):
            remedy = f'write region = {{patch = "{table}"}}' if isinstance(table, str) else None
            raise ConfigError("skin.region must be a table", value=repr(table), remedy=remedy)
        kinds = [k for k in _REGIONS if any(key == k or key.startswith(f"{k}_") for key in table)]
        if len(kinds) != 1:
            value = f"{' and '.join(kinds) or 'none'} in [skin.region]"
            raise ConfigError(
                "kind of a region", value=value, limit=f"one of {', '.join(_REGIONS)}"
            )
        for key in ("direction", "normal"):
            if key in table and (len(table[key]) != 3 or not np.any(table[key])):
                raise ConfigError(f"{where}.{key} must be a vector of 3", value=table[key])
        found: Region = from_table(_REGIONS[kinds[0]], table, where)
        check_fields(found)
        return found

    def make(self, body: Body, folder: Path) -> Skin:
        check_fields(self)
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
    urdf: str = "puma560.urdf"
    tip: str = "tool0"
    folders: tuple[str, ...] = ()
    payload: float = quantity("kg", 1.0, least=0.0, most=1e3)
    mount: tuple[float, float, float] | None = quantity("m", None)
    mount_angles: tuple[float, float, float] = quantity("rad", (0.0, 0.0, 0.0))
    base: tuple[float, float, float] = quantity("m", (0.0, 0.0, 0.0), least=-10, most=10)
    base_angles: tuple[float, float, float] = quantity("rad", (0.0, 0.0, 0.0))

    def pose(self) -> Array | None:
        """T_tip_body from a position and a rotation vector, or None."""
        check_fields(self)
        if self.mount is None:
            return None
        return transform(exp_so3(self.mount_angles), self.mount)

    def stand(self) -> Array:
        """T_w_base from a position and a rotation vector."""
        check_fields(self)
        return transform(exp_so3(self.base_angles), self.base)


@dataclass(frozen=True)
class WordsTable:
    name: str | None = None
    description: str | None = None
    contact: str | None = None


@dataclass(frozen=True)
class BudgetTable:
    budget: float | None = quantity("m", None, above=0.0)


def given(**options: Any) -> dict[str, Any]:
    """The options that are given."""
    return {key: value for key, value in options.items() if value is not None}


def body_table(table: Mapping[str, Any]) -> Any:
    """The checked table of a body; its `make(folder)` makes it."""
    if "mesh" in table:
        return from_table(_Mesh, table, "body")
    shape = table.get("shape")
    if shape is None:
        raise ConfigError("[body] lacks shape or mesh", remedy=f"shape: {', '.join(_SHAPES)}")
    if str(shape) not in _SHAPES:
        raise UnknownNameError("shape", shape, _SHAPES, " in [body]")
    return from_table(_SHAPES[str(shape)], table, "body")
