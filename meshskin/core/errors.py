"""Exceptions: each message is one line with the wrong value, the limit and the remedy.

Every exception that meshskin raises derives from `MeshskinError`. The command line prints its
message and exits with code 2.
"""

from __future__ import annotations

import difflib
import sys
import warnings
from collections import Counter
from collections.abc import Iterable


def _printable(text: str) -> str:
    """The text on one line without control characters, which damaged files may contain."""
    return "".join(c if c.isprintable() else " " if c.isspace() else "?" for c in text)


class MeshskinError(Exception):
    """Base of all exceptions: what is wrong, the wrong value, its limit, the remedy."""

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


def reason(error: Exception) -> str:
    """Why a file cannot be read: the words of the system, without its number and the file's name,
    which the message has."""
    return str(getattr(error, "strerror", None) or error)


class ConfigError(MeshskinError):
    """A configuration file or value that cannot be used."""


SHOWN = 40
"""Known names that a message lists: all of the package's own; a URDF has hundreds of links."""


class UnknownNameError(ConfigError):
    """A name that does not exist; the message lists the nearest known names."""

    def __init__(self, kind: str, name: object, known: Iterable[str], where: str = "") -> None:
        self.known = sorted(known)
        near = difflib.get_close_matches(str(name), self.known, n=3, cutoff=0.5)
        more = f" and {len(self.known) - SHOWN} more" if len(self.known) > SHOWN else ""
        listed = f"known: {', '.join(self.known[:SHOWN])}{more}"
        remedy = f"did you mean {' or '.join(near)}?" if near else listed
        super().__init__(f"unknown {kind} {name!r}{where}", remedy=remedy)


class MeshError(MeshskinError):
    """A mesh that cannot be used as a body."""


class SkinError(MeshskinError):
    """A skin that cannot be generated, read or used."""


class ContactError(MeshskinError):
    """A contact outside the range of a contact model."""


class ArmError(MeshskinError):
    """A robot description that cannot be used."""


class ReachError(MeshskinError):
    """A pose that the arm cannot reach."""


class SimulationError(MeshskinError):
    """A simulation that left its valid range; the message gives the time and the state."""


class PlaceError(SimulationError):
    """A path of the contact that ends: at an edge of the body, where contact is lost, where the
    body flies off, or where the loop diverges."""


class EdgeError(PlaceError):
    """A contact that runs over an edge of the body."""


class LoopError(PlaceError):
    """A closed loop that diverges."""


class TuningError(MeshskinError):
    """Demands on the closed loop that no gains meet; the message says which to relax."""


class RecordingError(MeshskinError):
    """A recording that cannot be read or is inconsistent."""


class CalibrationError(MeshskinError):
    """Data that do not determine the requested quantities."""


class UnconvergedError(CalibrationError):
    """An estimate whose steps do not come to an end at an optimum."""


class GraphError(MeshskinError):
    """A pose graph that cannot be read or solved."""


class StudyError(MeshskinError):
    """A study that cannot be run, or that was stopped."""


class OutOfTime(MeshskinError):
    """Work that was ended by its deadline."""


class OutputError(MeshskinError):
    """A file or folder that cannot be written."""


class LeftOutWarning(UserWarning):
    """Taxels that a result leaves out; the message counts them by reason."""


def warn_left_out(what: str, reasons: Iterable[str], count: int) -> None:
    """Warn the caller of a public function of the taxels that its result leaves out.

    what: what was not done to them; reasons: why, one text a taxel; count: number of all taxels.
    Functions of meshskin that call a public function decide themselves what they say.
    """
    found = Counter(reasons).most_common()
    caller = sys._getframe(2).f_globals.get("__name__", "")
    if found and not caller.startswith("meshskin."):
        lost = sum(number for _, number in found)
        words = "; ".join(f"{number}: {why}" for why, number in found)
        verb = "is" if lost == 1 else "are"
        text = _printable(f"{lost} of {count} taxels {verb} not {what} ({words})")
        warnings.warn(text, LeftOutWarning, stacklevel=3)
