"""Touching a skin at chosen points: with the arm under the closed loop, or by presses alone.

What touches keeps its effects from call to call, so that drift and hysteresis go on.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pyarrow as pa

from ..core.errors import CalibrationError, ReachError
from ..core.se3 import Array
from ..exploration.path import Path
from ..exploration.point_contacts import nearest_neighbour_order, point_contacts
from ..recording.recording import Recording
from ..scene.scene import Scene
from .readout import effect_chain
from .simulate import simulate
from .state_machine import PHASES, SLIDE
from .static_contacts import APART, floating, press

DWELL = 0.05
"""Rest of a touch after the force has settled, s."""

Touch = Callable[[Array], tuple[Recording, Array]]
"""points (k, 3) -> the recording of one contact a point that can be touched, and why each (k,) that
cannot be is left out ("" where it is not)."""
Toucher = Callable[[Scene, int], Touch]
"""(scene, seed) -> what touches; its effects go on from call to call."""


def pressed(scene: Scene, seed: int) -> Touch:
    """Contacts at rest, without arm and closed loop: in milliseconds. A `Toucher`.

    Raises ConfigError for an effect of an arm's joints.
    """
    chain = effect_chain(floating(scene), seed)

    def touch(points: Array) -> tuple[Recording, Array]:
        hit = scene.body.closest(points)
        why = scene.rig.contact_reasons(hit.point, hit.normal)
        good = why == ""
        _require_one(why)
        recording = press(scene, points[good], chain=chain)
        chain.start_next_run(APART)
        return recording, why

    return touch


def touched(scene: Scene, seed: int) -> Touch:
    """Contacts made by the closed loop: set down, settled, read once, lifted off. A `Toucher`."""
    chain = effect_chain(scene, seed)

    def touch(points: Array) -> tuple[Recording, Array]:
        order = nearest_neighbour_order(points)
        dwell = max(round(DWELL / scene.loop.dt), scene.frame_steps)
        found, reasons = point_contacts(scene.rig, points[order], dwell, scene.loop.dt)
        why = np.empty_like(reasons)
        why[order] = reasons
        _require_one(why)
        recording = simulate(scene, path=Path.concatenate(found), chain=chain)
        chain.start_next_run(APART)
        return last_of_each(recording), why

    return touch


def _require_one(why: Array) -> None:
    """Refuse a call of whose points (k,) none can be touched, with the first's reason."""
    if not (why == "").any():
        raise ReachError(f"none of the contacts can be made: {why[0]}", value=len(why))


def last_of_each(recording: Recording) -> Recording:
    """The last contact of every stretch of sliding: one settled contact a touch."""
    if recording.motion is None:
        raise CalibrationError("a recording without motion does not tell its touches apart")
    motion = recording.motion
    slide = np.asarray(motion.column("phase").to_pylist()) == PHASES[SLIDE]
    time = motion.column("time").to_numpy()
    ends = time[np.flatnonzero(slide & ~np.append(slide[1:], False))]
    rows = np.unique(np.searchsorted(recording.time, ends, side="right") - 1)
    kept = recording.time[rows]
    heard = np.isin(recording.readings.column("time").to_numpy(), kept)
    return Recording(
        recording.contacts.take(pa.array(rows)),
        recording.readings.filter(pa.array(heard)),
        recording.metadata,
    )


def together(first: Recording, second: Recording) -> Recording:
    """Two recordings of the same skin as one, the second APART after the first."""
    shift = float(first.time[-1] - second.time[0]) + APART

    def later(table: Any) -> Any:
        times = pa.array(table.column("time").to_numpy() + shift)
        return table.set_column(0, table.schema.field(0), times)

    return Recording(
        pa.concat_tables([first.contacts, later(second.contacts)]),
        pa.concat_tables([first.readings, later(second.readings)]),
        first.metadata,
    )
