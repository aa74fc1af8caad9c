"""meshskin: self-calibration of robot skin on any body mesh.

Simulate how a robot presses its skin-covered body on an indenter, estimate the pose of every taxel
from the recording, and state the uncertainty. Public names are imported when they are first used;
they stand in `__init__.pyi`, which type checkers read, too (SPEC 1 of Scientific Python).
"""

from __future__ import annotations

from typing import Any

import lazy_loader

__version__ = "0.2.0"

_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'meshskin' has no attribute {name!r}")
    from .core.field_docs import document_fields

    found = _load(name)
    return document_fields(found) if isinstance(found, type) else found
