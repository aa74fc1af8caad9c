"""Static contacts: the indenter pressed at chosen points, at rest, without the closed loop.

A recording of them takes milliseconds: for studies of the information in a set of contacts, for
trying an exploration before a robot runs it, and for an indenter that is carried to the body. Each
contact is at rest at its force and is a touch of its own: the contacts are PRESS_INTERVAL apart, so
that effects with a memory (shear, delayed readings) find that the contact was lost in between.
"""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
from numpy.typing import ArrayLike

from ..core.arguments import check_array, check_integer, check_type, check_vectors
from ..core.arrays import Array
from ..core.errors import RecordingError
from ..core.progress import Progress, Stage
from ..core.provenance import provenance
from ..core.se3 import exp_so3, shortest_rotation, transform
from ..exploration.path import Path
from ..recording.recording import Recording
from ..scene.scene import Scene
from .closed_loop_model import state_of_pose
from .readout import effect_pipeline, make_frames, recording_metadata, sensor_tables

if TYPE_CHECKING:
    from ..effects import EffectPipeline
    from ..effects.frames import Frames
    from ..geometry.surface.closest_point import Closest

BATCH_CELLS = 2e5
"""Largest number of pressures (presses times taxels) computed at once: below a second."""
PRESS_INTERVAL = 1.0
"""Time from one static contact to the next, s: about what an arm takes. Effects with a memory need
more than a few frame periods."""
MAX_DISTANCE = 0.05
"""Largest median distance, m, of the given points from the surface, on which they are projected: a
larger one is a mistake of units or of the frame."""


def press(
    scene: Scene,
    points: ArrayLike,
    force: ArrayLike | None = None,
    spin: ArrayLike = 0.0,
    seed: int = 0,
    chain: EffectPipeline | None = None,
    progress: Progress | None = None,
) -> Recording:
    """The recording of the indenter pressed on the body at `points` (m, 3), body frame, m.

    force (m,), N: by default the reference force. spin (m,), rad: rotation of the body about the
    indenter's direction; its skin faces the indenter. All effects of the scene act, as in
    `simulate`, except those of an arm's joints, which raise ConfigError. chain: the effects of
    earlier presses, of the scene as `without_arm` returns it, to continue instead of new ones of
    the seed. progress("press", done, total): called between batches of presses. Raises
    RecordingError without points, for points far from the body, for forces that
    are not positive, or for spins that are not finite. ContactError where the
    contact model holds at none of the points; warns where it holds at some only.

    >>> scene = ms.Scene.load("sphere")
    >>> len(ms.press(scene, scene.skin.positions[:3], force=[2.0, 3.0, 4.0]).time)
    3
    """
    check_type(Scene, scene, "what is pressed")
    check_integer("seed", seed, least=0)
    scene = without_arm(scene)
    given = check_vectors("points to press", points, error=RecordingError)
    if not len(given):
        raise RecordingError("there is no point to press", remedy="give one contact point or more")
    hit, count = scene.body.closest(given), len(given)
    _check_distance(hit.distance)
    forces = _for_each(
        "forces of presses", scene.law.force_reference if force is None else force, count
    )
    if not (forces > 0).all():
        raise RecordingError(
            "forces of presses must be positive", value=f"{forces.min():g} N", limit="above 0 N"
        )
    turn = exp_so3(_for_each("spins of presses", spin, count)[:, None] * [0.0, 0.0, 1.0])
    down = shortest_rotation(hit.normal, [0.0, 0.0, -1.0])
    limits = scene.model.exceeded_limits(
        forces, hit.curvature, scene.indenter.radius, scene.material.effective_modulus
    )
    beyond = limits[limits != ""]  # there a contact has no known pressures
    if len(beyond) == count:
        replace(scene.indentation, force=forces[0]).patch(scene.model.name, hit.curvature[0])
    if len(beyond):
        words = f"{scene.model.name} contact does not hold in {len(beyond)} of {count} presses"
        warnings.warn(f"{words}, whose readings are not those of a skin: {beyond[0]}", stacklevel=2)
    frames = _static_frames(scene, hit, forces, scene.indenter.rotation @ (turn @ down))
    return _record(scene, frames, chain or effect_pipeline(scene, seed), seed, progress)


def press_path(scene: Scene, path: Path, seed: int, chain: EffectPipeline | None) -> Recording:
    """The recording of one contact at each row of a path, at the path's forces.

    The body's orientations are those of the path's poses; otherwise as `press`.
    """
    forces = path.forces
    if forces is None:
        forces = np.full(len(path.points), scene.law.force_reference)
    frames = _static_frames(scene, scene.body.closest(path.points), forces, path.poses[:, :3, :3])
    return _record(scene, frames, chain or effect_pipeline(scene, seed), seed)


def _record(
    scene: Scene, frames: Frames, chain: EffectPipeline, seed: int, progress: Progress | None = None
) -> Recording:
    """The recording of static contacts."""
    count, size = len(frames), max(int(BATCH_CELLS / len(scene.skin)), 1)
    stage, batches = Stage(progress, "press", -(-count // size)), []
    for k in range(0, count, size):
        batches.append(sensor_tables(scene, frames.rows(slice(k, k + size)), chain))
        stage.step()
    contacts, readings = (pa.concat_tables(part) for part in zip(*batches, strict=True))
    made = provenance(scene=scene.name, seed=seed, presses=count)
    return Recording(contacts, readings, recording_metadata(scene) | {"provenance": made})


def without_arm(scene: Scene) -> Scene:
    """The scene with a body that moves freely, without the arm."""
    return scene.with_(loop=replace(scene.loop, mode="quasi_static"))


def _for_each(what: str, values: ArrayLike, count: int) -> Array:
    """One finite value (count,) for each press. Raises RecordingError."""
    given = check_array(what, values, error=RecordingError)
    if given.shape not in ((), (count,)):
        raise RecordingError(
            f"{what} must be one number, or one per point",
            value=f"shape {given.shape}",
            limit=f"({count},)",
        )
    if not np.isfinite(given).all():
        raise RecordingError(f"{what} must be finite", value=given[~np.isfinite(given)][0])
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


def _static_frames(scene: Scene, hit: Closest, forces: Array, rotations: Array) -> Frames:
    """Frames of static contacts (m) at forces (m,), N, the body at rotations R_w_b (m, 3, 3)."""
    patches = scene.reading_model.patches(forces, hit.curvature)
    centres = hit.point + (scene.indenter.radius - patches.depth)[:, None] * hit.normal
    place = np.array(scene.indenter.position) - np.einsum("kij,kj->ki", rotations, centres)
    time = PRESS_INTERVAL * np.arange(float(len(forces)))
    q = state_of_pose(transform(rotations, place))
    return make_frames(scene, time, hit.point, hit.normal, forces, centres, q)
