"""What the law hears of the contact: its depth and force now, or as they were some steps ago.

A delay of k steps adds k pairs (depth, force) to the state, the oldest first; without a delay there
are none. The dynamics always feel the contact of the moment. Until the first reading has come, the
law hears zeros: neither a gap nor a force.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from .surface_contact import Touch


@dataclass(frozen=True)
class DelayedReading:
    """A reading of the contact."""

    depth: ca.SX
    """m."""
    force: ca.SX
    """N."""


def delayed_reading(memory: ca.SX, touch: Touch) -> DelayedReading:
    """What the law hears with the readings `memory` (2 k,) on their way."""
    if memory.shape[0] == 0:
        return DelayedReading(touch.depth, touch.force)
    return DelayedReading(memory[0], memory[1])


def kept(memory: ca.SX, touch: Touch) -> ca.SX:
    """The readings (2 k,) that are on their way after this step."""
    if memory.shape[0] == 0:
        return memory
    return ca.vertcat(memory[2:], touch.depth, touch.force)
