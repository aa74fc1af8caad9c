"""How well the contact force followed its reference."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..core.errors import SimulationError
from ..core.se3 import Array

BAND = 0.02
"""Settled: within this part of the reference, for good until the contact point moves."""
PRESSED = ("touch", "hold", "slide")
"""Phases in which the law holds the force."""


@dataclass(frozen=True)
class ForceResponse:
    """The force after the first touch, against a constant reference."""

    reference: float
    """N."""
    touch: float
    """Time of the first touch, s."""
    mean: float
    """Mean force after settling, N."""
    std: float
    """Standard deviation after settling, N."""
    overshoot: float
    """Largest force over the reference before the contact moves, less one; 0 if never above."""
    settling: float
    """Time from touch until the force stays within 2 % of the reference, s; inf if it does not
    before the contact point moves."""
    disturbance: float
    """Largest difference from the reference after settling, relative to it."""
    lost: int
    """Steps without contact that the law should have held."""


def force_response(
    time: Array, force: Array, reference: float, phase: Sequence[str] | None = None
) -> ForceResponse:
    """The response in the force (k,) at `time` (k,), s. Raises SimulationError without contact.

    phase (k,): of the exploration; without it, all is one touch. In the air between two places the
    law holds nothing: those steps are left out.
    """
    names = np.full(len(time), PRESSED[0]) if phase is None else np.asarray(phase)
    held = np.isin(names, PRESSED)
    t, f, names = time[held], force[held], names[held]
    touched = np.flatnonzero(f > 0)
    if not len(touched):
        raise SimulationError("the recording has no contact force", remedy="check the indenter")
    t, f, names = t[touched[0] :], f[touched[0] :], names[touched[0] :]
    moving = np.flatnonzero(names == "slide")
    still = int(moving[0]) if len(moving) else len(f)
    outside = np.flatnonzero(np.abs(f[:still] - reference) > BAND * reference)
    first = int(outside[-1]) + 1 if len(outside) else 0
    in_time = first < still
    settled = f[first:] if in_time else f
    return ForceResponse(
        reference=reference,
        touch=float(t[0]),
        mean=float(settled.mean()),
        std=float(settled.std()),
        overshoot=max(float(f[:still].max(initial=0.0)) / reference - 1.0, 0.0),
        settling=float(t[first] - t[0]) if in_time else float("inf"),
        disturbance=float(np.abs(settled / reference - 1.0).max()),
        lost=int(np.count_nonzero(f == 0)),
    )
