"""The fields of a dataclass in words: type, unit, default, limits, and the text below each field.

`help` of a class shows its docstring only, not the texts below its fields; `document_fields` adds
them, with what `config.quantity` knows of each field. They are read from the source when they are
first asked for.
"""

from __future__ import annotations

import ast
import dataclasses
import inspect
import json
import textwrap
from collections.abc import Iterator
from dataclasses import MISSING, dataclass
from functools import cache
from itertools import pairwise
from typing import Any, TypeVar

from .arguments import repr_short
from .config import UNITS

T = TypeVar("T")


@dataclass(frozen=True)
class FieldDoc:
    """One field of a dataclass."""

    name: str
    """Name of the field, an argument of the class."""
    kind: str
    """Its annotation, as the source writes it."""
    unit: str | None
    """SI unit, "" for a number without one; None: not a quantity."""
    default: str | None
    """The default as Python writes it; None: the field is required."""
    limits: str
    """Bounds in words, such as "above 0, at most 1"; "": there are none."""
    text: str
    """The text below the field in the source."""

    def __str__(self) -> str:
        default = "required" if self.default is None else f"default {self.default}"
        facts = (self.kind, self.unit, self.limits, default)
        text = textwrap.fill(self.text, 90, initial_indent=" " * 4, subsequent_indent=" " * 4)
        head = f"{self.name} : {', '.join(filter(None, facts))}"
        return f"{head}\n{text}" if text else head


def field_docs(cls: type) -> tuple[FieldDoc, ...]:
    """The fields of a dataclass that its callers can give, in the order of its arguments."""
    texts = _texts(cls)
    return tuple(
        FieldDoc(
            name=field.name,
            kind=field.type if isinstance(field.type, str) else field.type.__name__,
            unit=field.metadata.get("unit"),
            default=_default(field),
            limits=limits(field),
            text=texts.get(field.name, ""),
        )
        for field in sorted(dataclasses.fields(cls), key=lambda field: bool(field.kw_only))
        if field.init and not field.name.startswith("_")
    )


def limits(field: dataclasses.Field[Any]) -> str:
    """The bounds of a field made by `quantity`, in words and SI units."""
    words = {"above": "above", "least": "at least", "most": "at most"}
    bounds = {word: field.metadata.get(key) for key, word in words.items()}
    return ", ".join(f"{w} {b:g}" for w, b in bounds.items() if b is not None)


def toml_lines(cls: type) -> Iterator[str]:
    """The keys of a dataclass in TOML with their defaults, in the unit that writes them shortest.

    Keys without a default are marked as required; those whose default is None are left out.
    """
    for field in dataclasses.fields(cls):
        suffixes = UNITS[field.metadata.get("unit", "")]
        required = field.default is MISSING
        if not required and field.default is not None:
            shown = {suffix: _toml(field.default, suffixes[suffix]) for suffix in suffixes}
        elif required:
            shown = dict.fromkeys(suffixes, "...  # required")
        else:
            continue
        suffix = min(shown, key=lambda one: len(shown[one]))
        key = f"{field.name}_{suffix}" if suffix else field.name
        yield f"{key} = {shown[suffix]}"


def _toml(value: Any, factor: float) -> str:
    """A default in TOML, in the unit with this factor to SI."""
    if isinstance(value, tuple):
        return f"[{', '.join(_toml(one, factor) for one in value)}]"
    if isinstance(value, bool | str):
        return json.dumps(value)
    return f"{value / factor:.12g}"


def document_fields(cls: type[T]) -> type[T]:
    """The dataclass with its fields in its docstring; other classes as they are."""
    if dataclasses.is_dataclass(cls) and not isinstance(vars(cls)["__doc__"], _Docstring):
        type.__setattr__(cls, "__doc__", _Docstring(cls.__doc__ or ""))
    return cls


class _Docstring:
    """A docstring with the fields of the class that is asked for it."""

    def __init__(self, text: str) -> None:
        self.text = inspect.cleandoc(text)

    def __get__(self, instance: object, owner: type) -> str:
        fields = "\n".join(map(str, field_docs(owner)))
        return f"{self.text}\n\nFields\n------\n{fields}\n" if fields else self.text


def _default(field: dataclasses.Field[Any]) -> str | None:
    """The default of a field, or the name of its default factory."""
    if field.default_factory is not MISSING:
        name = getattr(field.default_factory, "__name__", "")
        return "see below" if name == "<lambda>" else f"{name}()"
    return None if field.default is MISSING else repr_short(field.default)


@cache
def _texts(cls: type) -> dict[str, str]:
    """Texts below the fields of a class and its bases, each on one line; none without sources."""
    found: dict[str, str] = {}
    for base in filter(dataclasses.is_dataclass, reversed(cls.__mro__)):
        try:
            source = textwrap.dedent(inspect.getsource(base))
        except (OSError, TypeError):  # no sources, or a class made in an interactive session
            continue
        (definition,) = ast.parse(source).body
        body = getattr(definition, "body", [])
        for field, text in pairwise(body):
            if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr):
                name, value = ast.unparse(field.target), getattr(text.value, "value", None)
                found[name] = " ".join(value.split()) if isinstance(value, str) else ""
    return found
