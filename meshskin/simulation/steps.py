"""Steps of the closed loop, as they were run."""

from __future__ import annotations

from dataclasses import dataclass

from ..core.se3 import Array


@dataclass(frozen=True)
class Steps:
    """A run of consecutive steps."""

    time: Array
    """(k,), s."""
    q: Array
    """Configuration (k, n): joint angles, or position and quaternion of the body."""
    outputs: Array
    """(k, m), see Loop.outputs."""
    phase: int
    readings: Array | None = None
    """Point pressures (k, taxels), Pa, where they were asked for."""
