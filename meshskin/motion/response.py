"""How well the contact force followed its reference."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import SimulationError
from ..se3 import Array

BAND = 0.02
"""Settled: within this part of the reference, for good until the contact point moves."""


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
    """Largest force over the reference, less one; 0 if never above."""
    settling: float
    """Time from touch until the force stays within 2 % of the reference, s; inf if never."""
    lost: int
    """Steps without contact after the touch."""


def force_response(time: Array, force: Array, reference: float) -> ForceResponse:
    """The response in the force (k,) at `time` (k,), s. Raises SimulationError without contact."""
    touched = np.flatnonzero(force > 0)
    if not len(touched):
        raise SimulationError("the recording has no contact force", remedy="check the indenter")
    t, f = time[touched[0] :], force[touched[0] :]
    outside = np.flatnonzero(np.abs(f - reference) > BAND * reference)
    first = int(outside[-1]) + 1 if len(outside) else 0
    settled = f[first:]
    return ForceResponse(
        reference=reference,
        touch=float(t[0]),
        mean=float(settled.mean()) if len(settled) else float(f.mean()),
        std=float(settled.std()) if len(settled) else float(f.std()),
        overshoot=max(float(f.max()) / reference - 1.0, 0.0),
        settling=float(t[first] - t[0]) if len(settled) else float("inf"),
        lost=int(np.count_nonzero(f == 0)),
    )
