"""Errors of meshskin: one line that names the value at fault, the limit, and what to do.

Every error that meshskin raises on purpose derives from `MeshskinError`; the command line turns it
into that one line and exit code 2.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def _printable(text: str) -> str:
    """The text on one line: of a damaged file it may repeat any bytes."""
    return "".join(c if c.isprintable() else " " if c.isspace() else "?" for c in text)


class MeshskinError(Exception):
    """Base of all errors: what is wrong, the value at fault, the limit it breaks, the remedy."""

    def __init__(
        self, what: str, *, value: object = None, limit: object = None, remedy: str | None = None
    ) -> None:
        self.what, self.value, self.limit, self.remedy = what, value, limit, remedy
        parts = [what]
        if value is not None:
            parts.append(f"got {value}")
        if limit is not None:
            parts.append(f"limit: {limit}")
        line = ", ".join(parts)
        super().__init__(_printable(f"{line}; {remedy}" if remedy else line))


class ConfigError(MeshskinError):
    """A configuration file or value that cannot be used."""


class UnknownNameError(ConfigError):
    """A name that does not exist; carries the nearest known names."""

    def __init__(self, kind: str, name: object, known: Iterable[str], where: str = "") -> None:
        self.known = sorted(known)
        near = difflib.get_close_matches(str(name), self.known, n=3, cutoff=0.5)
        remedy = f"did you mean {' or '.join(near)}?" if near else f"known: {', '.join(self.known)}"
        super().__init__(f"unknown {kind} {name!r}{where}", remedy=remedy)


class MeshError(MeshskinError):
    """A mesh that is no usable body."""


class SkinError(MeshskinError):
    """A skin layout that cannot be made, read or used."""


class ContactError(MeshskinError):
    """A contact outside a model's range."""


class ArmError(MeshskinError):
    """A robot description that cannot be used."""


class ReachError(MeshskinError):
    """A pose that the arm cannot take."""


class SimulationError(MeshskinError):
    """A simulation that left its range; carries the time and the state."""


class PlaceError(SimulationError):
    """A place that cannot be explored, or no further: an edge of the body, or no contact."""


class TuningError(MeshskinError):
    """Demands on the closed loop that no gains meet; says which to relax."""


class RecordingError(MeshskinError):
    """A recording that cannot be read or is not consistent."""


class CalibrationError(MeshskinError):
    """Data that do not determine what was asked for."""


class GraphError(MeshskinError):
    """A pose graph that cannot be read or solved."""


class StudyError(MeshskinError):
    """A study that cannot be run, or that had to stop."""


class OutputError(MeshskinError):
    """A place that cannot be written."""
