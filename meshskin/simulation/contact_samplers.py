"""Samplers: recordings of contacts at points that are chosen set by set.

The contacts are static or by the closed loop. A sampler keeps its effects from call to call, so
that drift and hysteresis continue.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pyarrow as pa

from ..core import arrow
from ..core.arrays import Array
from ..core.errors import CalibrationError, ReachError
from ..exploration.contact_plan import nearest_neighbour_order, point_contacts
from ..exploration.path import Path
from ..recording.recording import Recording
from ..scene.scene import Scene
from .readout import effect_pipeline
from .simulate import simulate
from .state_machine import PHASES, SLIDE
from .static_contacts import PRESS_INTERVAL, press, without_arm

DWELL_TIME = 0.05
"""Time at rest on a point after the force has settled, s: several frame periods, so that at least
one frame is read there."""

ContactSampler = Callable[[Array], tuple[Recording, Array]]
"""points (k, 3), body frame, m -> the recording of one contact at each point that can be touched,
and the reason (k,) why a point is left out ("" where it is not)."""
ContactSamplerFactory = Callable[[Scene, int], ContactSampler]
"""(scene, seed) -> a contact sampler."""


def static_sampler(scene: Scene, seed: int) -> ContactSampler:
    """A sampler of static contacts, without arm and closed loop: milliseconds a call.

    Raises ConfigError for an effect of an arm's joints.
    """
    pipeline = effect_pipeline(without_arm(scene), seed)

    def sample(points: Array) -> tuple[Recording, Array]:
        hit = scene.body.closest(points)
        reasons = scene.rig.contact_reasons(hit.point, hit.normal)
        _require_one(reasons)
        recording = press(scene, points[reasons == ""], chain=pipeline)
        pipeline.start_next_run(PRESS_INTERVAL)
        return recording, reasons

    return sample


def closed_loop_sampler(scene: Scene, seed: int) -> ContactSampler:
    """A sampler by the closed loop: approach, touch, settle, one reading, and lift off."""
    pipeline = effect_pipeline(scene, seed)

    def sample(points: Array) -> tuple[Recording, Array]:
        order = nearest_neighbour_order(points)
        dwell = max(round(DWELL_TIME / scene.loop.dt), scene.frame_steps)
        paths, found = point_contacts(scene.rig, points[order], dwell, scene.loop.dt)
        reasons = np.empty_like(found)
        reasons[order] = found
        _require_one(reasons)
        recording = simulate(scene, path=Path.concatenate(paths), chain=pipeline)
        pipeline.start_next_run(PRESS_INTERVAL)
        return settled_contacts(recording), reasons

    return sample


def _require_one(reasons: Array) -> None:
    """Raise ReachError with the first reason where none of the points (k,) can be touched."""
    if not (reasons == "").any():
        raise ReachError(f"none of the contacts can be made: {reasons[0]}", value=len(reasons))


def settled_contacts(recording: Recording) -> Recording:
    """The last contact of every interval of sliding: one settled contact a touch.

    A touch without a valid contact in its interval (all of its frames were outside the contact
    model's range) is left out.
    """
    if recording.motion is None:
        raise CalibrationError("a recording without motion has no phases to tell touches apart")
    motion = recording.motion
    slide = arrow.words(motion.column("phase")) == PHASES[SLIDE]
    edges = np.diff(slide.astype(int), prepend=0, append=0)
    time = arrow.values(motion.column("time"))
    first, last = time[edges[:-1] > 0], time[edges[1:] < 0]
    rows = np.searchsorted(recording.time, last, side="right") - 1
    rows = rows[(rows >= 0) & (recording.time[rows] >= first)]
    kept = np.isin(arrow.values(recording.readings.column("time")), recording.time[rows])
    return Recording(
        recording.contacts.take(arrow.column(rows)),
        recording.readings.filter(arrow.column(kept)),
        recording.metadata,
    )


def concatenate(first: Recording, second: Recording) -> Recording:
    """Two recordings of the same skin as one, the second PRESS_INTERVAL after the first."""
    both = len(first.time) and len(second.time)
    shift = float(first.time[-1] - second.time[0]) + PRESS_INTERVAL if both else 0.0

    def later(table: pa.Table) -> pa.Table:
        times = arrow.column(arrow.values(table.column("time")) + shift)
        return table.set_column(0, table.schema.field(0), times)

    return Recording(
        pa.concat_tables([first.contacts, later(second.contacts)]),
        pa.concat_tables([first.readings, later(second.readings)]),
        first.metadata,
    )
