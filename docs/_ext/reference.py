"""Pages of the reference that the build writes: Python, scene files, effects, command line."""

from __future__ import annotations

import argparse
import ast
import dataclasses
import inspect
import re
from collections.abc import Iterable
from importlib import import_module
from pathlib import Path
from typing import Any

import effect_pictures
from markup import rst

import meshskin as ms
from meshskin import cli, effects
from meshskin.contact.indenter import Indenter
from meshskin.contact.material import Material
from meshskin.core.config import UNITS
from meshskin.core.field_docs import FieldDoc, field_docs
from meshskin.recording.log_map import StreamMap
from meshskin.scene import schema
from meshskin.scene.settings import Exploration, Law, Loop, Readout

PACKAGE = Path(ms.__file__).parent
FIELDS = "\n\nFields\n------\n"
"""What separates a docstring from the list of its fields (core/field_docs.py)."""
PREFERRED = {"m": "mm", "rad": "deg", "Pa": "kpa", "s": "s"}
"""Suffixes of the keys whose defaults do not say which reads best."""


def write(folder: Path, pictures: Path) -> None:
    """Write all pages below `folder`; the effects' pictures are kept in `pictures`."""
    pages = {
        **python_pages(),
        "scene": scene_page(),
        "command_line": command_line_page(),
        "log_map.txt": key_table(StreamMap) + "\n",
        **effect_pages(folder, pictures),
    }
    for name, text in pages.items():
        write_changed(folder / (name if name.endswith(".txt") else f"{name}.md"), text)
    for stale in set(folder.rglob("*.md")) - {folder / f"{name}.md" for name in pages}:
        stale.unlink()


def write_changed(path: Path, text: str) -> None:
    """Write a page unless it is there: Sphinx reads only changed pages anew."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.is_file() or path.read_text(encoding="utf-8") != text:
        path.write_text(text, encoding="utf-8")


# Python -------------------------------------------------------------------------------------------


def python_pages() -> dict[str, str]:
    """One page for each public name, one for the types of their values, and the index."""
    wings: dict[str, list[str]] = {}
    for file in sorted(PACKAGE.glob("*/__init__.py"), key=_wing_rank):
        wings[file.parent.name] = []
    for name in ms.__all__:
        found = getattr(ms, name)
        home = found.__name__ if inspect.ismodule(found) else found.__module__
        wings[home.split(".")[1]].append(name)
    pages = {f"python/{name}": _python_page(name) for name in ms.__all__}
    lines = ["# Python", "", "`import meshskin as ms`; names are imported when first used.", ""]
    for wing, names in wings.items():
        if not names:
            continue
        doc = inspect.getdoc(import_module(f"meshskin.{wing}")) or ""
        title = _first(doc).removeprefix(f"{wing.capitalize()}: ")
        lines += [f"## {wing.capitalize()}", "", title[:1].upper() + title[1:], ""]
        for name in sorted(names, key=str.lower):
            lines += [f"[`ms.{name}`](python/{name}.md)", f": {_first(_doc(name))}", ""]
    lines += ["## Their values", "", "[Types of results, fields and properties](python/values.md)."]
    listed = "\n".join(f"python/{name}" for name in sorted(ms.__all__, key=str.lower))
    lines += ["", "```{toctree}", ":hidden:", "", listed, "python/values", "```"]
    return pages | {"python": "\n".join(lines) + "\n", "python/values": _values_page()}


def _wing_rank(file: Path) -> int:
    """Place of a wing in the order of the public pages: that of the data."""
    order = "geometry skin contact effects robot scene exploration recording simulation estimation"
    names = order.split()
    return names.index(file.parent.name) if file.parent.name in names else len(names)


def _doc(name: str) -> str:
    return (inspect.getdoc(getattr(ms, name)) or "").split(FIELDS)[0]


def _first(doc: str) -> str:
    """The first paragraph of a docstring on one line."""
    return " ".join(doc.split("\n\n")[0].split())


def _python_page(name: str) -> str:
    found = getattr(ms, name)
    if inspect.ismodule(found):
        body = f".. automodule:: meshskin.{name}\n\n"
        for member in (n for n in found.__all__ if not n.isupper()):
            obj, path = getattr(found, member), f"meshskin.{name}.{member}"
            body += _autoclass(path, obj) if inspect.isclass(obj) else _autofunction(path)
            body += "\n"
    elif inspect.isclass(found):
        body = _autoclass(f"meshskin.{name}", found)
    else:
        body = _autofunction(f"meshskin.{name}")
    return f"# ms.{name}\n\n```{{eval-rst}}\n{body}```\n"


def _autoclass(path: str, cls: type) -> str:
    fields = [f.name for f in dataclasses.fields(cls)] if dataclasses.is_dataclass(cls) else []
    exclude = f"   :exclude-members: {', '.join(fields)}\n" if fields else ""
    return f".. autoclass:: {path}\n   :members:\n{exclude}"


def _autofunction(path: str) -> str:
    return f".. autofunction:: {path}\n"


def _values_page() -> str:
    """The classes that results, fields and properties of public names have."""
    homes: dict[str, list[str]] = {}
    for file in sorted(PACKAGE.rglob("*.py")):
        module = ".".join(["meshskin", *file.relative_to(PACKAGE).with_suffix("").parts])
        for node in ast.parse(file.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef):
                homes.setdefault(node.name, []).append(module.removesuffix(".__init__"))
    modules = [m for m in (getattr(ms, name) for name in ms.__all__) if inspect.ismodule(m)]
    public = {*ms.__all__, *(name for module in modules for name in module.__all__)}
    names = {
        found
        for name in ms.__all__
        for annotation in _annotations(getattr(ms, name))
        for found in re.findall(r"\b[A-Z]\w+", annotation)
        if len(homes.get(found, ())) == 1 and found not in public
    }
    lines = ["# Types of values", "", "What public functions return and public fields hold.", ""]
    for name in sorted(names):
        path = f"{homes[name][0]}.{name}"
        cls = getattr(import_module(homes[name][0]), name)
        lines += [f"## {name}", "", "```{eval-rst}", _autoclass(path, cls) + "```", ""]
    return "\n".join(lines)


def _annotations(found: Any) -> Iterable[str]:
    """What a function returns; what the methods of a class return and its fields are."""
    if inspect.isfunction(found):
        yield str(inspect.signature(found).return_annotation)
    if inspect.isclass(found):
        if dataclasses.is_dataclass(found):
            yield from (field.kind for field in field_docs(found))
        for name, member in vars(found).items():
            function = getattr(member, "__func__", getattr(member, "func", member))
            function = function.fget if isinstance(function, property) else function
            if not name.startswith("_") and inspect.isfunction(function):
                yield from _annotations(function)


def document(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Docstrings as reStructuredText; the fields of dataclasses as a list of definitions."""
    text, _, _ = "\n".join(lines).partition(FIELDS)
    made = rst(text)
    if inspect.isroutine(obj):
        made = "\n\n".join(_arguments(block, _parameters(obj)) for block in made.split("\n\n"))
    if inspect.isclass(obj) and dataclasses.is_dataclass(obj):
        if text.startswith(f"{obj.__name__}("):  # the signature, of a class without a docstring
            made = ""
        fields = [_definition(field) for field in field_docs(obj)]
        made += "\n\n.. rubric:: Fields\n\n" + "\n".join(fields) if fields else ""
    lines[:] = made.splitlines()


def _parameters(function: Any) -> list[str]:
    try:
        return [name for name in inspect.signature(function).parameters if name != "self"]
    except (TypeError, ValueError):
        return []


def _arguments(block: str, names: list[str]) -> str:
    """A paragraph that describes arguments ("seed: of all streams. out: ..."), one a definition.

    The errors that the paragraph ends with are a paragraph of their own.
    """
    text, raised, errors = " ".join(block.split()).partition(" Raises ")
    either = "|".join(map(re.escape, names))
    parts = re.split(rf"(?:^|(?<=[.;] ))({either})( \([^)]*\))?(, [\w/ ]+)?: ", text)
    listed = len(parts) > 1 and (not parts[0].strip() or parts[0].rstrip().endswith("."))
    if not names or not listed or block.startswith("..") or "    " in block:
        return block
    made = [parts[0].strip()] if parts[0].strip() else []
    for k in range(1, len(parts), 4):
        name, shape, unit, words = (part or "" for part in parts[k : k + 4])
        words = words.strip().removesuffix(";")
        rest = ""
        if k + 4 >= len(parts):  # what follows the last argument is about all
            words, _, rest = words.partition(". ")
        made.append(f"`{name}`{shape}{unit}\n    {words[:1].upper()}{words[1:]}")
        made += [rest] if rest else []
    return "\n\n".join([*made, *([f"Raises {errors}"] if raised else [])])


def _definition(field: FieldDoc) -> str:
    default = "required" if field.default is None else f"default `{field.default}`"
    facts = ", ".join(filter(None, (f"`{field.kind}`", field.unit, rst(field.limits), default)))
    return f"`{field.name}` : {facts}\n" + (f"    {rst(field.text)}\n" if field.text else "")


def sign(
    app: Any, what: str, name: str, obj: Any, options: Any, signature: str | None, returns: Any
) -> tuple[str | None, str | None] | None:
    """Signatures of dataclasses name the required fields alone; the list of fields has the rest."""
    if not (inspect.isclass(obj) and dataclasses.is_dataclass(obj)):
        alias = r"TypeAliasForwardRef\('(\w+)'\)"  # how Sphinx writes an alias within a union
        shown = [re.sub(alias, r"\1", part or "") or None for part in (signature, returns)]
        return shown[0], shown[1]
    required = [field.name for field in field_docs(obj) if field.default is None]
    optional = [field for field in field_docs(obj) if field.default is not None]
    return f"({', '.join([*required, *(['...'] if optional else [])])})", None


# Scene files --------------------------------------------------------------------------------------


def scene_page() -> str:
    """Every key of a scene file, from the classes that check it."""
    units = "\n".join(
        f"| {unit} | {', '.join(f'`_{s}`' for s in suffixes)} |"
        for unit, suffixes in UNITS.items()
        if unit
    )
    top = [(schema.SceneTable, "Top of the file", "")]
    bodies = [(cls, f'[body] with `shape = "{name}"`', "") for name, cls in schema._SHAPES.items()]
    regions = [(cls, f"[skin] `region` with `{key}`", "") for key, cls in schema._REGIONS.items()]
    tables = [
        *top, *bodies, (schema._Mesh, "[body] with `mesh`", ""),
        (schema.SkinTable, "[skin]", ""), *regions,
        (Material, "[material]", ""), (Indenter, "[indenter]", ""), (schema.ArmTable, "[arm]", ""),
        (Law, "[law]", ""), (Exploration, "[exploration]", ""), (Loop, "[loop]", ""),
        (Readout, "[readout]", ""),
    ]  # fmt: skip
    doc = inspect.getdoc(import_module("meshskin.scene.file")) or ""
    parts = [f"# Scene files\n\n{doc.partition(chr(10))[2].strip()}\n"]
    parts.append(
        "A key ends in the unit of its value; another suffix of the same unit may stand in its "
        f"place:\n\n| unit | suffixes |\n|---|---|\n{units}\n\nEffects are on [pages of their own]"
        "(effects.md); a table `[[effects]]` has the effect's name as `kind`, and its parameters.\n"
    )
    for cls, title, _ in tables:
        text = (inspect.getdoc(cls) or "").split(FIELDS)[0]
        text = "" if text.startswith(f"{cls.__name__}(") or "[" in text[:1] else _first(text)
        parts.append(f"## {title}\n\n{text}\n\n{key_table(cls)}\n")
    return "\n".join(parts)


def key_table(cls: type) -> str:
    """A table of a dataclass's keys in TOML: key, default, limits, meaning."""
    rows = ["| key | default | limits | meaning |", "|---|---|---|---|"]
    values = {f.name: f for f in dataclasses.fields(cls)}
    for doc in field_docs(cls):
        field = values[doc.name]
        default = None if field.default is dataclasses.MISSING else field.default
        suffix, factor = _suffix(doc.unit, default)
        key = f"`{doc.name}_{suffix}`" if suffix else f"`{doc.name}`"
        shown = "required" if doc.default is None else _toml(default, factor)
        bounds = {"above": "above", "least": "at least", "most": "at most"}
        limits = ", ".join(
            f"{word} {field.metadata[bound] / factor:g}"
            for bound, word in bounds.items()
            if field.metadata.get(bound) is not None
        )
        rows.append(f"| {key} | {shown} | {limits} | {_cell(doc.text)} |")
    return "\n".join(rows)


def _suffix(unit: str | None, default: Any) -> tuple[str, float]:
    """The suffix with which the default is shortest, with its factor to SI."""
    suffixes = UNITS[unit or ""]
    values = default if isinstance(default, tuple) else (default,)
    if default is None or not any(values):
        best = PREFERRED.get(unit or "", next(iter(suffixes)))
    else:
        best = min(suffixes, key=lambda s: len(_toml(default, suffixes[s])))
    return best, suffixes[best]


def _toml(value: Any, factor: float) -> str:
    """A default as a scene file writes it."""
    if value is None:
        return "none"
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    if isinstance(value, str):
        return f'`"{value}"`'
    if isinstance(value, tuple):
        return f"`[{', '.join(_toml(v, factor).strip('`') for v in value)}]`"
    return f"`{value / factor:g}`"


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


# Effects ------------------------------------------------------------------------------------------


def effect_pages(folder: Path, pictures: Path) -> dict[str, str]:
    """A page for each registered effect, and their table in the order of the signal."""
    drawn = effect_pictures.draw(pictures)
    pages, rows = {}, ["| effect | stage | what it does |", "|---|---|---|"]
    for name in effects.NAMES:
        cls = effects.find(name)
        summary = _first((inspect.getdoc(cls) or "").split(FIELDS)[0])
        rows.append(f"| [`{name}`](effects/{name}.md) | {cls.stage} | {_cell(summary)} |")
        pages[f"effects/{name}"] = _effect_page(name, cls, drawn[name], folder)
    listed = "\n".join(f"effects/{name}" for name in effects.NAMES)
    intro = (effects.__doc__ or "").strip().partition("\n\n")[2]
    pages["effects"] = "\n".join(
        ["# Effects", "", intro, "", effect_pictures.CAPTION, "", *rows, "",
         "```{toctree}", ":hidden:", "", listed, "```", ""]
    )  # fmt: skip
    return pages


def _effect_page(name: str, cls: Any, picture: Path | None, folder: Path) -> str:
    doc = inspect.getdoc(import_module(cls.__module__)) or ""
    summary = (inspect.getdoc(cls) or "").split(FIELDS)[0]
    facts = [f"Stage: {cls.stage}"]
    facts += [f"requires {', '.join(cls.requires)}"] if cls.requires else []
    facts += [f"excludes {', '.join(cls.excludes)}"] if cls.excludes else []
    facts.append(f"computing time {1e9 * cls.cost:g} ns per taxel and frame")
    required = [d.name for d in field_docs(cls) if d.default is None]
    example = f'[[effects]]\nkind = "{name}"'
    parts = [f"# {name}", doc, f"*{summary}*", "; ".join(facts) + "."]
    if picture is not None:
        inside = folder / "effects" / picture.name
        inside.parent.mkdir(parents=True, exist_ok=True)
        if not inside.is_file() or inside.read_bytes() != picture.read_bytes():
            inside.write_bytes(picture.read_bytes())
        width = f":width: {effect_pictures.width(picture)}px"
        parts.append(f"```{{image}} {picture.name}\n:alt: {name}, off and on\n{width}\n```")
    if not required:
        parts.append(f"```toml\n{example}\n```")
    if field_docs(cls):
        parts.append(key_table(cls))
    bound = _first(inspect.getdoc(cls.bound) or "")
    bound = bound[:1].lower() + bound[1:]
    parts.append(f"Bound on the taxel error, m, where the estimate ignores it: {bound}")
    return "\n\n".join(parts) + "\n"


# Command line -------------------------------------------------------------------------------------


def command_line_page() -> str:
    """Every command with its arguments, from the parsers."""
    parser = cli._parser()
    (commands,) = [a for a in parser._actions if isinstance(a, argparse._SubParsersAction)]
    helps = {action.dest: action.help for action in commands._choices_actions}
    codes = (inspect.getdoc(cli.main) or "").partition("\n\n")[2]
    parts = [f"# Command line\n\nExit codes: {codes}\n"]
    for name, command in commands.choices.items():
        title = (helps[name] or "").strip()
        parts.append(f"## meshskin {name}\n\n{title[:1].upper()}{title[1:]}.\n")
        parts.append(f"```text\n{command.format_usage().removeprefix('usage: ').rstrip()}\n```\n")
        if command.description:
            parts.append(f"{command.description.strip()}\n")
        for action in command._actions:
            if not isinstance(action, argparse._HelpAction) and action.help != argparse.SUPPRESS:
                parts.append(_argument(action))
    return "\n".join(parts)


def _argument(action: argparse.Action) -> str:
    """One argument as a definition."""
    value = action.metavar or (action.dest.upper() if action.nargs != 0 else "")
    value = " ".join(value) if isinstance(value, tuple) else value
    if action.choices and not action.metavar:
        value = "{" + ",".join(map(str, action.choices)) + "}"
    name = ", ".join(f"`{option} {value}`".replace(" `", "`") for option in action.option_strings)
    text = (action.help or "").replace("%%", "%")
    text = f"{text[:1].upper()}{text[1:]}." if text else "No text."
    return f"{name or f'`{value}`'}\n: {text}{' Required.' if _is_required(action) else ''}\n"


def _is_required(action: argparse.Action) -> bool:
    return bool(action.option_strings and action.required)
