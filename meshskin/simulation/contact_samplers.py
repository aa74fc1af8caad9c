"""Recordings of contacts at chosen points, static or by the closed loop.

`press` records static contacts without the closed loop, in milliseconds: for studies of the
information in a set of contacts, and for trying an exploration before a robot runs it. Each contact
is at rest at its force and is a touch of its own: the contacts are PRESS_INTERVAL apart, so that
effects with a memory (shear, delayed readings) find that the contact was lost in between. A sampler
keeps its effects from call to call, so that drift and hysteresis continue.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
from numpy.typing import ArrayLike

from ..core.arguments import check_array, check_type, check_vectors
from ..core.arrays import Array
from ..core.errors import CalibrationError, ReachError, RecordingError
from ..core.provenance import provenance
from ..core.se3 import exp_so3, shortest_rotation, transform
from ..exploration.path import Path
from ..exploration.point_contacts import nearest_neighbour_order, point_contacts
from ..recording.recording import Recording
from ..scene.scene import Scene
from .closed_loop_model import state_of_pose
from .readout import FRAME_CELLS, effect_pipeline, make_frames, recording_metadata, sensor_tables
from .simulate import simulate
from .state_machine import PHASES, SLIDE

if TYPE_CHECKING:
    from ..effects import EffectPipeline
    from ..effects.frames import Frames
    from ..geometry.surface.closest_point import Closest

PRESS_INTERVAL = 1.0
"""Time from one static contact to the next, s: about what an arm takes. Effects with a memory need
more than a few frame periods."""
MAX_DISTANCE = 0.05
"""Largest median distance, m, of the given points from the surface, on which they are projected: a
larger one is a mistake of units or of the frame."""
DWELL_TIME = 0.05
"""Time at rest on a point after the force has settled, s: several frame periods, so that at least
one frame is read there."""

ContactSampler = Callable[[Array], tuple[Recording, Array]]
"""points (k, 3), body frame, m -> the recording of one contact at each point that can be touched,
and the reason (k,) why a point is left out ("" where it is not)."""
ContactSamplerFactory = Callable[[Scene, int], ContactSampler]
"""(scene, seed) -> a contact sampler."""


def press(
    scene: Scene,
    points: ArrayLike,
    force: ArrayLike | None = None,
    spin: ArrayLike = 0.0,
    seed: int = 0,
    chain: EffectPipeline | None = None,
) -> Recording:
    """The recording of the indenter pressed on the body at `points` (m, 3), body frame, m.

    force (m,), N: by default the reference force. spin (m,), rad: rotation of the body about the
    indenter's direction; its skin faces the indenter. All effects of the scene act, as in
    `simulate`, except those of an arm's joints, which raise ConfigError. chain: the effects of
    earlier presses, of the scene as `without_arm` returns it, to continue instead of new ones of
    the seed. Raises RecordingError without points, for points far from the body, or for forces that
    are not positive.
    """
    check_type(Scene, scene, "what is pressed")
    scene = without_arm(scene)
    given = check_vectors("points to press", points, error=RecordingError)
    if not len(given):
        raise RecordingError("there is no point to press", remedy="give one contact point or more")
    hit, count = scene.body.closest(given), len(given)
    _check_distance(hit.distance)
    forces = _forces(scene.law.force_reference if force is None else force, count)
    frames = _static_frames(scene, hit, forces, np.broadcast_to(spin, count))
    chain = chain or effect_pipeline(scene, seed)
    size = max(int(FRAME_CELLS / len(scene.skin)), 1)
    batches = [
        sensor_tables(scene, frames.rows(slice(k, k + size)), chain) for k in range(0, count, size)
    ]
    contacts, readings = (pa.concat_tables(part) for part in zip(*batches, strict=True))
    origin = provenance(scene=scene.name, seed=seed, presses=count)
    return Recording(contacts, readings, recording_metadata(scene) | {"provenance": origin})


def without_arm(scene: Scene) -> Scene:
    """The scene with a body that moves freely, without the arm."""
    return scene.with_(loop=replace(scene.loop, mode="quasi_static"))


def _forces(force: ArrayLike, count: int) -> Array:
    """The forces (count,), N, of the presses. Raises RecordingError."""
    given = check_array("forces of presses", force, error=RecordingError)
    if given.shape not in ((), (count,)):
        raise RecordingError(
            "press needs one force, or one per point",
            value=f"shape {given.shape}",
            limit=f"({count},)",
        )
    bad = given[~((given > 0) & np.isfinite(given))]
    if bad.size:
        raise RecordingError(
            "forces of presses must be positive", value=f"{bad[0]:g} N", limit="above 0 N"
        )
    return np.array(np.broadcast_to(given, count))


def _check_distance(distance: Array) -> None:
    """Raise RecordingError for points far from the surface, at `distance` (m,), m."""
    typical = float(np.median(np.abs(distance)))
    if not typical <= MAX_DISTANCE:
        raise RecordingError(
            "the points to press are not on the body",
            value=f"median distance {typical:.3g} m from its surface",
            limit=f"{MAX_DISTANCE} m",
            remedy="give them in metres, in the body's frame",
        )


def _static_frames(scene: Scene, hit: Closest, forces: Array, spin: Array) -> Frames:
    """Frames of static contacts (m) at forces (m,), N, the body turned by `spin` (m,), rad."""
    patches = scene.model.patches(
        force=forces,
        curvature=hit.curvature,
        indenter_radius=scene.indenter.radius,
        effective_modulus=scene.material.effective_modulus,
    )
    centres = hit.point + (scene.indenter.radius - patches.depth)[:, None] * hit.normal
    down = shortest_rotation(hit.normal, [0.0, 0.0, -1.0])
    turned = exp_so3(spin[:, None] * [0.0, 0.0, 1.0]) @ down
    turned = scene.indenter.rotation @ turned
    place = np.array(scene.indenter.position) - np.einsum("kij,kj->ki", turned, centres)
    time = PRESS_INTERVAL * np.arange(float(len(forces)))
    q = state_of_pose(transform(turned, place))
    return make_frames(scene, time, hit.point, hit.normal, forces, centres, q)


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
    slide = np.asarray(motion.column("phase").to_pylist()) == PHASES[SLIDE]
    edges = np.diff(slide.astype(int), prepend=0, append=0)
    time = motion.column("time").to_numpy()
    first, last = time[edges[:-1] > 0], time[edges[1:] < 0]
    rows = np.searchsorted(recording.time, last, side="right") - 1
    rows = rows[(rows >= 0) & (recording.time[rows] >= first)]
    kept = np.isin(recording.readings.column("time").to_numpy(), recording.time[rows])
    return Recording(
        recording.contacts.take(pa.array(rows)),
        recording.readings.filter(pa.array(kept)),
        recording.metadata,
    )


def concatenate(first: Recording, second: Recording) -> Recording:
    """Two recordings of the same skin as one, the second PRESS_INTERVAL after the first."""
    shift = float(first.time[-1] - second.time[0]) + PRESS_INTERVAL

    def later(table: pa.Table) -> pa.Table:
        times = pa.array(table.column("time").to_numpy() + shift)
        return table.set_column(0, table.schema.field(0), times)

    return Recording(
        pa.concat_tables([first.contacts, later(second.contacts)]),
        pa.concat_tables([first.readings, later(second.readings)]),
        first.metadata,
    )
