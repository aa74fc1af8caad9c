"""The figures of a report, as functions of plain arrays (SI units, body frame) -> Figure."""

from __future__ import annotations

from .curves import PAPER_CLAIMS, Claim, errors, force, initial_error
from .maps import coverage, estimates, iterations, uncertainty
from .plane import Plane, tangent_plane
from .precision import accuracy_time
from .theme import save

__all__ = [
    "PAPER_CLAIMS",
    "Claim",
    "Plane",
    "accuracy_time",
    "coverage",
    "errors",
    "estimates",
    "force",
    "initial_error",
    "iterations",
    "save",
    "tangent_plane",
    "uncertainty",
]
