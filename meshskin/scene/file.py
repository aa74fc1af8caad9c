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
from pathlib import Path
from typing import Any

from .. import effects
from ..contact.indenter import Indenter
from ..contact.material import Material
from ..core.arguments import repr_short
from ..core.config import check_fields, check_table, from_table, merge, read_toml
from ..core.errors import ConfigError, UnknownNameError
from ..robot.arm import Arm
from . import shipped_scenes
from .scene import Scene
from .schema import ArmTable, BudgetTable, SkinTable, WordsTable, body_table, given
from .settings import Exploration, Law, Loop, Readout

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


def tables(name: str | Path) -> tuple[dict[str, Any], Path]:
    """The merged TOML tables of a scene and the folder that its paths start from."""
    path = shipped_scenes.find_scene(name)
    data = read_toml(path)
    seen = {path.resolve()}
    while "extends" in data:
        parent_name = data.pop("extends")
        beside = path.parent / f"{parent_name}.toml"
        parent = beside if beside.is_file() else shipped_scenes.find_scene(parent_name)
        if parent.resolve() in seen:
            raise ConfigError(f"{path.name} extends itself through {parent.name}")
        seen.add(parent.resolve())
        data = merge(_without_rivals(read_toml(parent), data), data)
    data.setdefault("name", path.stem)
    return data, path.parent


def _without_rivals(parent: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """A parent's tables without the body and region whose place those of `over` take."""
    kept = dict(parent)
    for key in ("body", "skin"):
        for table in (parent, over):
            check_table(table.get(key, {}), key)
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
    body = body_table(data["body"]).make(folder)
    skin = from_table(SkinTable, data["skin"], "skin").make(body, folder)
    table = from_table(ArmTable, data.get("arm", {}), "arm")
    urdf = (
        folder / table.urdf
        if (folder / table.urdf).is_file()
        else shipped_scenes.folder() / table.urdf
    )
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
    check_fields(body_table(data["body"]))
    skin = from_table(SkinTable, data["skin"], "skin")
    check_fields(skin)
    skin.part()
    check_fields(from_table(ArmTable, data.get("arm", {}), "arm"))
    parts(data)


def parts(data: Mapping[str, Any]) -> dict[str, Any]:
    """The scene's parts beside body, skin and arm, by field name."""
    plain: dict[str, Any] = {
        key: from_table(cls, data[key], key) for key, cls in _PLAIN.items() if key in data
    }
    words = {key: data[key] for key in WordsTable.__dataclass_fields__ if key in data}
    named = from_table(WordsTable, words, "scene")
    return plain | given(**vars(named)) | _effects(data)


def _effects(data: Mapping[str, Any]) -> dict[str, Any]:
    """The scene's effects, what a budget may put on beside them, and the budget."""
    known = from_table(
        BudgetTable, {k: v for k, v in data.items() if k.startswith("budget")}, "scene"
    )
    check_fields(known)
    tables, budget = data.get("effects", []), known.budget
    if isinstance(tables, str):
        if tables != AUTO:
            raise ConfigError(
                "effects must be a list of tables", value=repr(tables), remedy=f'or "{AUTO}"'
            )
        tables, budget = [], budget or BUDGET
    check_listed("effects", tables)
    if "candidates" in data and budget is None:
        raise ConfigError(
            "candidates need a budget that chooses from them", remedy='add effects = "auto"'
        )
    found: dict[str, Any] = {"effects": effects.ordered(map(effects.from_table, tables))}
    if "candidates" in data:
        listed = data["candidates"]
        check_listed("candidates", listed)
        found["candidates"] = tuple(effects.from_table(e, "candidates") for e in listed)
    return found | {"budget": budget}


def check_listed(key: str, tables: Any) -> None:
    """Raise ConfigError for what is no list of tables."""
    if not isinstance(tables, list) or not all(isinstance(table, Mapping) for table in tables):
        raise ConfigError(
            f"{key} must be a list of tables", value=repr_short(tables), remedy=f"write [[{key}]]"
        )
