"""Scenes as TOML files.

Tables: body, skin, material, indenter, arm, law, exploration, loop, readout, and effects (a list).
With `effects = "auto"`, or a `budget_mm`, an error budget decides which effects are on, among the
effects and the `candidates` (a list, too; by default all registered effects).
`extends = "sphere"` starts from another scene; a body of another kind replaces its body.
Relative paths start from the folder of the file that they are written in.
The part of a body that a skin covers is `region = {patch = "palm"}` in [skin], by a name in the
mesh file (`meshskin check` lists them), or {direction = [0, 0, -1], angle_deg = 40},
{point_mm = [0, 0, 90], radius_mm = 30}, {normal = [0, 0, 1], offset_mm = 20}, {faces = [0, 1, 2]}.
In the world z is up. [indenter] direction = [1, 0, 0] points from its support to its tip; [arm]
base_m is the position of the arm's root link, base_angles_deg its rotation vector.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from .. import effects
from ..contact.indenter import Indenter
from ..contact.material import Material
from ..core.arguments import repr_short
from ..core.config import check_table, from_table, merge, read_toml
from ..core.errors import ConfigError, UnknownNameError
from ..robot.arm import Arm
from . import shipped_scenes
from .schema import ArmTable, SceneTable, SkinTable, body_table, given
from .settings import Exploration, Law, Loop, Readout

_PLAIN: dict[str, type] = {
    "material": Material,
    "indenter": Indenter,
    "law": Law,
    "exploration": Exploration,
    "loop": Loop,
    "readout": Readout,
}
_TEXT = ("name", "description", "contact")
_TABLES = (
    *_PLAIN, "body", "skin", "arm", "effects", "candidates", "budget_mm", "budget_m", "budget_um",
    "extends", *_TEXT,
)  # fmt: skip
_PATHS = {"body": ("mesh", "folders"), "skin": ("file",), "arm": ("urdf", "folders")}
"""Keys of tables whose values are files or folders."""
AUTO = "auto"
"""Value of `effects` with which an error budget decides."""
BUDGET = 0.2e-3
"""Error budget of a scene that gives none, m. Chosen: a tenth of a taxel's radius."""


def read_tables(name: str | Path) -> tuple[dict[str, Any], Path]:
    """The merged TOML tables of a scene, and the folder where its relative paths start."""
    path = file = shipped_scenes.find_scene(name)
    data = read_toml(path)
    seen = {path.resolve()}
    while "extends" in data:
        parent = _extended(file, data.pop("extends"))
        if parent.resolve() in seen:
            raise ConfigError(f"{file.name} extends itself through {parent.name}")
        seen.add(parent.resolve())
        tables, file = read_toml(parent), parent
        if parent.parent.resolve() != path.parent.resolve():
            tables = _located(tables, parent.parent.resolve())
        data = merge(_without_replaced(tables, data), data)
    data.setdefault("name", path.stem)
    return data, path.parent


def _extended(file: Path, name: Any) -> Path:
    """The scene that a scene file extends: a file beside it, by name or path, or a shipped one."""
    for beside in (file.parent / f"{name}.toml", file.parent / f"{name}"):
        if beside.suffix == ".toml" and beside.is_file():
            return beside
    return shipped_scenes.find_scene(name)


def _located(tables: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """The tables of a scene with its relative paths resolved against `folder`; names of shipped
    files that `folder` lacks are unchanged."""

    def located(value: Any) -> Any:
        if isinstance(value, list):
            return [located(item) for item in value]
        if not isinstance(value, str):
            return value
        shipped = (shipped_scenes.folder() / value).exists() and not (folder / value).exists()
        return value if shipped else str(folder / value)

    found = dict(tables)
    for table, keys in _PATHS.items():
        if isinstance(found.get(table), Mapping):
            paths = {key: located(found[table][key]) for key in keys if key in found[table]}
            found[table] = {**found[table], **paths}
    return found


def _without_replaced(parent: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """A parent's tables without its body and region where `over` replaces them."""
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


def scene_fields(data: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """The fields of the Scene that merged tables describe; relative paths start from `folder`.

    Raises ConfigError.
    """
    _check_keys(data)
    body = body_table(data["body"]).make(folder)
    skin = from_table(SkinTable, data["skin"], "skin").make(body, folder)
    table = from_table(ArmTable, data.get("arm", {}), "arm")
    beside = folder / table.urdf
    urdf = beside if beside.is_file() else shipped_scenes.folder() / table.urdf
    arm = Arm.from_urdf(urdf, tip=table.tip, folders=[folder / name for name in table.folders])
    parts = {"body": body, "skin": skin, "arm": arm.with_base(table.base_pose())}
    return parts | {"payload": table.payload, "mount": table.mount_pose()} | plain_fields(data)


def check_tables(data: Mapping[str, Any]) -> None:
    """Check every key and bound of merged tables without making the scene. Raises ConfigError."""
    _check_keys(data)
    body_table(data["body"])
    from_table(SkinTable, data["skin"], "skin").part()
    from_table(ArmTable, data.get("arm", {}), "arm")
    plain_fields(data)


def plain_fields(data: Mapping[str, Any]) -> dict[str, Any]:
    """The scene's fields except its body, skin, arm, payload and mount."""
    plain: dict[str, Any] = {
        key: from_table(cls, data[key], key) for key, cls in _PLAIN.items() if key in data
    }
    keys = [key for key in data if key in _TEXT or key.startswith("budget")]
    table = from_table(SceneTable, {key: data[key] for key in keys}, "scene")
    return plain | given(vars(table)) | _effect_fields(data, table.budget)


def _check_keys(data: Mapping[str, Any]) -> None:
    """Raise ConfigError for an unknown key or a missing table."""
    where = f" in {data.get('name', 'the scene')}"
    for key in data:
        if key not in _TABLES:
            raise UnknownNameError("key", key, _TABLES, where)
    for key in ("body", "skin"):
        if not isinstance(data.get(key), Mapping):
            raise ConfigError(f"the table [{key}] is missing{where}", remedy=f"add [{key}]")


def _effect_fields(data: Mapping[str, Any], budget: float | None) -> dict[str, Any]:
    """The scene's effects, the candidates of an error budget, and the budget, m."""
    listed = data.get("effects", [])
    if isinstance(listed, str):
        if listed != AUTO:
            raise ConfigError(
                "effects must be a list of tables", value=repr(listed), remedy=f'or "{AUTO}"'
            )
        listed, budget = [], budget or BUDGET
    check_table_list("effects", listed)
    found: dict[str, Any] = {"effects": effects.ordered(map(effects.from_table, listed))}
    if "candidates" in data:
        if budget is None:
            raise ConfigError(
                "candidates need an error budget that chooses among them",
                remedy='add effects = "auto"',
            )
        candidates = data["candidates"]
        check_table_list("candidates", candidates)
        found["candidates"] = tuple(effects.from_table(e, "candidates") for e in candidates)
    return found | {"budget": budget}


def check_table_list(key: str, tables: Any) -> None:
    """Raise ConfigError unless `tables` is a list of tables."""
    if not isinstance(tables, list) or not all(isinstance(table, Mapping) for table in tables):
        raise ConfigError(
            f"{key} must be a list of tables", value=repr_short(tables), remedy=f"write [[{key}]]"
        )
