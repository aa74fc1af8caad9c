"""The scene that the cases of a study change, and the changes by dotted key.

A key names a table of the scene file and a quantity in it (`material.young_kpa`,
`skin.spacing_mm`). `effects.KIND.QUANTITY` changes an effect, and adds it if it is absent;
`effects.KIND` adds an effect (true) or removes it (false).
"""

from __future__ import annotations

import dataclasses
import hashlib
import inspect
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ...core import config
from ...core.arguments import check_type
from ...core.atomic_io import plain
from ...core.errors import ConfigError, StudyError, UnknownNameError
from ...core.provenance import digest
from ...effects import find
from ...scene import shipped_scenes

if TYPE_CHECKING:
    from ...scene.scene import Scene

# Modules of the scene are imported where they are used: a worker that needs no scene starts three
# times as fast without them.

SceneTable = Mapping[str, Any]


class BaseScene:
    """The scene that parameters change; here: none, all parameters belong to the run function."""

    def check(self, parameters: SceneTable) -> None:
        """Check every key and value. Raises ConfigError."""

    def identity(self, parameters: SceneTable) -> str:
        """Text that is equal for two sets of parameters if and only if the scenes are equal."""
        return canonical_json(parameters)

    def scene(self, parameters: SceneTable) -> Scene:
        """The scene with these parameters. Raises MeshskinError kinds."""
        raise StudyError("the study has no scene", remedy="give it a base")


@dataclass(frozen=True)
class SceneFile(BaseScene):
    """The merged tables of a scene file; files that they name are identified by their content."""

    tables: SceneTable
    folder: Path
    _digests: dict[Path, str] = field(default_factory=dict, repr=False, compare=False)

    @classmethod
    def load(cls, name: str | Path) -> SceneFile:
        """The tables of a shipped scene or a TOML file."""
        from ...scene.file import read_tables

        found, folder = read_tables(name)
        return cls(found, folder.resolve())

    def check(self, parameters: SceneTable) -> None:
        """Check every key and value. Raises ConfigError."""
        from ...scene.file import check_tables

        check_tables(changed_tables(self.tables, parameters))

    def identity(self, parameters: SceneTable) -> str:
        """The changed tables without names, and with digests in place of files."""
        data = changed_tables(self.tables, parameters)
        for table, key in (("body", "mesh"), ("skin", "file"), ("arm", "urdf")):
            part = data.get(table)
            if isinstance(part, Mapping) and key in part:
                data[table] = {**part, key: self._content(str(part[key]))}
        words = {k: v for k, v in data.items() if k not in ("name", "description")}
        return canonical_json(words) + own_sources(data)

    def _content(self, name: str) -> str:
        """Digest of a file beside the scene or shipped; its name if there is no such file."""
        for path in (self.folder / name, shipped_scenes.folder() / name):
            if path in self._digests:
                return self._digests[path]
            if path.is_file():
                with path.open("rb") as file:
                    self._digests[path] = hashlib.file_digest(file, "sha256").hexdigest()[:16]
                return self._digests[path]
        return name

    def scene(self, parameters: SceneTable) -> Scene:
        """The scene with these parameters. Raises MeshskinError kinds."""
        from ...scene.scene import Scene

        return Scene.from_tables(changed_tables(self.tables, parameters), self.folder)


class SceneObject(BaseScene):
    """A scene made in Python; its body, skin and arm are fixed, the rest can be changed."""

    FIXED = ("body", "skin", "arm", "payload", "mount")

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._tables = _tables_of(scene)
        body = scene.body
        self._fixed = digest(
            *(np.asarray(a) for m in (body.mesh, body.facets) for a in (m.vertices, m.faces)),
            repr((body.exact, body.degree)),
            *(np.asarray(a) for a in (scene.skin.poses, scene.skin.ids, scene.mount_pose)),
            scene.arm.base,
            repr((scene.skin.disc_radius, scene.arm.tip, scene.arm.folders, scene.payload)),
            scene.arm.urdf,
        )

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle without the caches of the scene (ray tracer, fitted surfaces)."""
        from trimesh import Trimesh

        scene, replace = self._scene, dataclasses.replace
        mesh = Trimesh(scene.body.mesh.vertices, scene.body.mesh.faces, process=False)
        body = replace(scene.body, mesh=mesh)
        return SceneObject, (replace(scene, body=body, arm=replace(scene.arm)),)

    def check(self, parameters: SceneTable) -> None:
        """Check every key and value. Raises ConfigError."""
        for key in parameters:
            if key.split(".")[0] in self.FIXED:
                raise ConfigError(
                    f"a scene made in Python keeps its {key.split('.')[0]}",
                    value=key,
                    remedy="give the base of the study as a scene's name or TOML file",
                )
        self._parts(parameters)

    def identity(self, parameters: SceneTable) -> str:
        """Digest of the fixed parts, and the changed tables."""
        data = changed_tables(self._tables, parameters)
        return self._fixed + canonical_json(data) + own_sources(data)

    def scene(self, parameters: SceneTable) -> Scene:
        """The scene with these parameters. Raises ConfigError."""
        return dataclasses.replace(self._scene, **self._parts(parameters))

    def _parts(self, parameters: SceneTable) -> dict[str, Any]:
        from ...scene.file import plain_fields

        data = changed_tables(self._tables, parameters)
        for key in data:
            if key not in self._tables:
                raise UnknownNameError("key", key, self._tables, " in the scene")
        return plain_fields(data)


def base_scene(base: str | Path | Scene | None) -> BaseScene:
    """The base of a study from the name or file of a scene, a Scene, or None."""
    if base is None:
        return BaseScene()
    if isinstance(base, str | Path):
        return SceneFile.load(base)
    from ...scene.scene import Scene

    check_type(Scene, base, "the base of a study")
    return SceneObject(base)


def changed_tables(data: SceneTable, parameters: SceneTable) -> dict[str, Any]:
    """The tables of a scene with the parameters applied. Raises ConfigError."""
    out = dict(data)
    for key, value in parameters.items():
        table, _, rest = key.partition(".")
        if table == "effects":
            out["effects"] = _with_effect(out.get("effects", []), rest, value)
        elif rest and isinstance(out.get(table, {}), Mapping):
            out[table] = config.merge(out.get(table, {}), {rest: value})
        elif rest or table != "contact":
            raise ConfigError(
                f"the key {key!r} names no quantity",
                remedy="write TABLE.QUANTITY as in a scene file, such as material.young_kpa",
            )
        else:
            out[key] = value
    return out


def _with_effect(effects: Any, rest: str, value: Any) -> list[dict[str, Any]]:
    """The list of effects with one changed, added or removed."""
    kind, _, quantity = rest.partition(".")
    if isinstance(effects, str):
        raise ConfigError(
            f"effects.{kind} cannot be changed where a budget decides on effects",
            value=f"effects = {effects!r}",
            remedy="list the effects in the scene",
        )
    from ...scene.file import check_table_list

    check_table_list("effects", effects)
    listed = [dict(effect) for effect in effects]
    found = next((effect for effect in listed if effect.get("kind") == kind), None)
    if not quantity and not isinstance(value, bool):
        raise ConfigError(
            f"effects.{kind} must be on or off", value=repr(value), limit="true or false"
        )
    if not quantity and not value:
        return [effect for effect in listed if effect is not found]
    if found is None:
        listed.append(found := {"kind": kind})
    if quantity:
        found.update(merged := config.merge(found, {quantity: value}))
        for stale in set(found) - set(merged):
            del found[stale]
    return listed


def _tables_of(scene: Scene) -> dict[str, Any]:
    """The tables, in SI units, of all parts of a scene except its body, skin and arm."""
    names = ("material", "indenter", "law", "exploration", "loop", "readout")
    out: dict[str, Any] = {name: config.to_table(getattr(scene, name)) for name in names}
    out["effects"] = [{"kind": effect.name, **config.to_table(effect)} for effect in scene.effects]
    if scene.candidates is not None:
        out["candidates"] = [{"kind": e.name, **config.to_table(e)} for e in scene.candidates]
    if scene.budget is not None:
        out["budget_m"] = scene.budget
    return out | {"contact": scene.contact}


def own_sources(tables: SceneTable) -> str:
    """The sources of the effects in the tables of a scene that are not of this package, whose
    source every key contains."""
    effects = [*tables.get("effects", ()), *tables.get("candidates", ())]
    kinds = map(find, sorted({str(table["kind"]) for table in effects if "kind" in table}))
    package = __name__.partition(".")[0]
    return "".join(source_text(k) for k in kinds if k.__module__.partition(".")[0] != package)


def source_text(code: Any) -> str:
    """The source of a function or class; empty where it has none. In a notebook that of a class is
    not found, that of its functions is."""
    try:
        return inspect.getsource(code)
    except (OSError, TypeError):
        parts = filter(inspect.isfunction, vars(code).values()) if inspect.isclass(code) else ()
        return "".join(map(source_text, parts))


def canonical_json(value: Any) -> str:
    """JSON that is equal for equal values: sorted keys, 3.0 as 3, NumPy numbers as Python's."""
    found = plain(value, lambda number: int(number) if number.is_integer() else number)
    return json.dumps(found, sort_keys=True, separators=(",", ":"), default=str)
