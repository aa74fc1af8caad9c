"""meshskin: self-calibration of robot skin on any body mesh.

Simulate how a robot presses its skin-covered body on an indenter, estimate the pose of every taxel
from the recording, and state the uncertainty. Public names are imported when they are first used;
they stand in `__init__.pyi`, which type checkers read, too (SPEC 1 of Scientific Python).
"""

from __future__ import annotations

import re
from importlib import import_module
from operator import itemgetter
from pathlib import Path
from typing import Any

__version__ = "0.2.0"

_STUB = Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")
_HOMES = {
    name: home or name
    for home, name in sorted(re.findall(r"from \.([\w.]*) import (\w+)", _STUB), key=itemgetter(1))
}
"""The module that defines each public name, in the order of the names."""

__all__ = list(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'meshskin' has no attribute {name!r}")
    home = import_module(f".{_HOMES[name]}", __name__)
    if name == _HOMES[name]:
        return home
    from .core.field_docs import document_fields

    found = getattr(home, name)
    return document_fields(found) if isinstance(found, type) else found


def __dir__() -> list[str]:
    return __all__
