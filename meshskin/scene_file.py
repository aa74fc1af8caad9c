"""Scenes as TOML files.

Tables: body, skin, material, indenter, arm, law, exploration, loop, readout, and effects (a list).
With `effects = "auto"`, or a `budget_mm`, an error budget decides what is on, among the effects
and the `candidates` (a list, too; by default all there are).
`extends = "sphere"` starts from another scene; a body of another kind takes the place of its body.
Relative paths are taken from the file's own folder. The part of a body that a skin is laid on is
`region = {patch = "palm"}` in [skin], by a name in the mesh file (`meshskin check` lists them), or
{direction = [0, 0, -1], angle_deg = 40}, {point_mm = [0, 0, 90], radius_mm = 30},
{normal = [0, 0, 1], offset_mm = 20}, {faces = [0, 1, 2]}.
In the world z is up. [indenter] direction = [1, 0, 0] is from its support to its tip; [arm] base_m
is where the arm's root link stands, base_angles_deg the rotation vector by which it is turned.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from . import library
from .config import build, check, merge, quantity, read_toml
from .errors import ConfigError, UnknownNameError
from .geometry.body import Body
from .geometry.region import Cap, Disc, Faces, HalfSpace, Patch, Region
from .geometry.skin import Skin
from .motion.arm import Arm
from .motion.law import Law
from .motion.path import Exploration
from .physics import effects
from .physics.indenter import Indenter
from .physics.material import Material
from .scene import Loop, Readout, Scene
from .se3 import Array, exp_so3, transform

_PLAIN: dict[str, type] = {
    "material": Material,
    "indenter": Indenter,
    "law": Law,
    "exploration": Exploration,
    "loop": Loop,
    "readout": Readout,
}
_BUDGET = ("budget_mm", "budget_m", "budget_um")
_TABLES = (
    *_PLAIN, "body", "skin", "arm", "effects", "candidates", *_BUDGET, "extends", "description",
    "contact", "name",
)  # fmt: skip
AUTO = "auto"
"""In place of a list of effects: an error budget decides."""
BUDGET = 0.2e-3
"""Error budget of a scene that gives none, m."""


@dataclass(frozen=True)
class _Sphere:
    shape: str
    radius: float = quantity("m", above=0.0)
    faces: int | None = quantity("", None, above=0)

    def make(self, folder: Path) -> Body:
        check(self)
        return Body.sphere(self.radius, **_given(faces=self.faces))


@dataclass(frozen=True)
class _Ellipsoid:
    shape: str
    radii: tuple[float, float, float] = quantity("m", above=0.0)
    faces: int | None = quantity("", None, above=0)

    def make(self, folder: Path) -> Body:
        check(self)
        return Body.ellipsoid(self.radii, **_given(faces=self.faces))


@dataclass(frozen=True)
class _Capsule:
    shape: str
    radius: float = quantity("m", above=0.0)
    length: float = quantity("m", above=0.0)
    faces: int | None = quantity("", None, above=0)

    def make(self, folder: Path) -> Body:
        check(self)
        return Body.capsule(self.radius, self.length, **_given(faces=self.faces))


@dataclass(frozen=True)
class _Torus:
    shape: str
    major: float = quantity("m", above=0.0)
    minor: float = quantity("m", above=0.0)
    faces: int | None = quantity("", None, above=0)

    def make(self, folder: Path) -> Body:
        check(self)
        return Body.torus(self.major, self.minor, **_given(faces=self.faces))


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
class _SkinTable:
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
            table |= _given(angle_rad=self.angle)
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
        found: Region = build(_REGIONS[kinds[0]], table, where)
        check(found)
        return found

    def make(self, body: Body, folder: Path) -> Skin:
        check(self)
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
class _ArmTable:
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
        check(self)
        if self.mount is None:
            return None
        return transform(exp_so3(self.mount_angles), self.mount)

    def stand(self) -> Array:
        """T_w_base from a position and a rotation vector."""
        check(self)
        return transform(exp_so3(self.base_angles), self.base)


@dataclass(frozen=True)
class _BudgetKeys:
    budget: float | None = quantity("m", None, above=0.0)


def _given(**options: Any) -> dict[str, Any]:
    """The options that are given."""
    return {key: value for key, value in options.items() if value is not None}


def tables(name: str | Path) -> tuple[dict[str, Any], Path]:
    """The merged TOML tables of a scene and the folder that its paths start from."""
    path = library.find_scene(name)
    data = read_toml(path)
    seen = {path.resolve()}
    while "extends" in data:
        parent_name = data.pop("extends")
        beside = path.parent / f"{parent_name}.toml"
        parent = beside if beside.is_file() else library.find_scene(parent_name)
        if parent.resolve() in seen:
            raise ConfigError(f"{path.name} extends itself through {parent.name}")
        seen.add(parent.resolve())
        data = merge(_without_rivals(read_toml(parent), data), data)
    data.setdefault("name", path.stem)
    return data, path.parent


def _without_rivals(parent: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """A parent's tables without the body and region whose place those of `over` take."""
    kept = dict(parent)
    old, new = kept.get("body", {}), over.get("body", {})
    if "mesh" in new or new.get("shape", old.get("shape")) != old.get("shape"):
        kept.pop("body", None)
    if "skin" in kept and any(
        key.startswith(("region", "direction")) for key in over.get("skin", ())
    ):
        kept["skin"] = {k: v for k, v in kept["skin"].items() if k != "region"}
    return kept


def load(name: str | Path) -> Scene:
    """Load a scene by name or file; see Scene.load."""
    return from_tables(*tables(name))


def from_tables(data: Mapping[str, Any], folder: Path) -> Scene:
    """The scene of merged tables; relative paths start from `folder`. Raises ConfigError."""
    check_keys(data)
    body = _body(data["body"]).make(folder)
    skin = build(_SkinTable, data["skin"], "skin").make(body, folder)
    table = build(_ArmTable, data.get("arm", {}), "arm")
    urdf = folder / table.urdf if (folder / table.urdf).is_file() else library.folder() / table.urdf
    arm = Arm.from_urdf(urdf, tip=table.tip, folders=[folder / name for name in table.folders])
    return Scene(
        body=body,
        skin=skin,
        arm=arm.standing(table.stand()),
        payload=table.payload,
        mount=table.pose(),
        **parts(data),
    )


def check_keys(data: Mapping[str, Any]) -> None:
    """Check that all tables are there and none is unknown. Raises ConfigError."""
    where = f" in {data.get('name', 'the scene')}"
    for key in data:
        if key not in _TABLES:
            raise UnknownNameError("key", key, _TABLES, where)
    for key in ("body", "skin"):
        if not isinstance(data.get(key), Mapping):
            raise ConfigError(f"the table [{key}] is missing{where}", remedy=f"add [{key}]")


def check_tables(data: Mapping[str, Any]) -> None:
    """Check every key and bound of merged tables without making the scene. Raises ConfigError."""
    check_keys(data)
    check(_body(data["body"]))
    skin = build(_SkinTable, data["skin"], "skin")
    check(skin)
    skin.part()
    check(build(_ArmTable, data.get("arm", {}), "arm"))
    parts(data)


def parts(data: Mapping[str, Any]) -> dict[str, Any]:
    """The scene's parts beside body, skin and arm, by field name."""
    plain: dict[str, Any] = {
        key: build(cls, data[key], key) for key, cls in _PLAIN.items() if key in data
    }
    named = _given(**{key: data.get(key) for key in ("name", "description", "contact")})
    return plain | named | _effects(data)


def _effects(data: Mapping[str, Any]) -> dict[str, Any]:
    """The scene's effects, what a budget may put on beside them, and the budget."""
    known = build(_BudgetKeys, {k: v for k, v in data.items() if k.startswith("budget")}, "scene")
    check(known)
    tables, budget = data.get("effects", []), known.budget
    if isinstance(tables, str):
        if tables != AUTO:
            raise ConfigError(
                "effects must be a list of tables", value=repr(tables), remedy=f'or "{AUTO}"'
            )
        tables, budget = [], budget or BUDGET
    if "candidates" in data and budget is None:
        raise ConfigError(
            "candidates need a budget that chooses from them", remedy='add effects = "auto"'
        )
    found: dict[str, Any] = {"effects": effects.ordered(map(effects.from_table, tables))}
    if "candidates" in data:
        listed = data["candidates"]
        found["candidates"] = tuple(effects.from_table(e, "candidates") for e in listed)
    return found | {"budget": budget}


def _body(table: Mapping[str, Any]) -> Any:
    """The checked table of a body; its `make(folder)` makes it."""
    if "mesh" in table:
        return build(_Mesh, table, "body")
    shape = table.get("shape")
    if shape is None:
        raise ConfigError("[body] lacks shape or mesh", remedy=f"shape: {', '.join(_SHAPES)}")
    if shape not in _SHAPES:
        raise UnknownNameError("shape", str(shape), _SHAPES, " in [body]")
    return build(_SHAPES[shape], table, "body")
