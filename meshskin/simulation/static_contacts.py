"""Presses: the recording of chosen contacts without the closed loop, in milliseconds.

For studies of what a set of contacts tells, and for trying an exploration before a robot runs it.
Each contact is at rest at its force, a touch of its own: they are APART, so that effects that look
back (shear, old readings) find the contact lost in between, not slid.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
from numpy.typing import ArrayLike

from ..core.arguments import check_array, check_type, check_vectors
from ..core.errors import RecordingError
from ..core.provenance import provenance
from ..core.se3 import Array, exp_so3, quaternion, shortest_rotation
from ..recording.recording import Recording
from ..scene.scene import Scene
from .readout import FRAME_CELLS, effect_chain, frames_at, header, sensor_tables

if TYPE_CHECKING:
    from ..effects import EffectPipeline
    from ..effects.frames import Frames
    from ..geometry.surface.closest_point import Closest

APART = 1.0
"""Time from one press to the next, s, as an arm would take it."""
FAR_OFF = 0.05
"""Most by which points to press may typically lie off the surface, m; they are put on it."""


def press(
    scene: Scene,
    points: ArrayLike,
    force: ArrayLike | None = None,
    spin: ArrayLike = 0.0,
    seed: int = 0,
    chain: EffectPipeline | None = None,
) -> Recording:
    """The recording of the indenter pressed on the body at `points` (m, 3), body frame, m.

    force (m,), N: the reference force by default. spin (m,), rad: how far the body is turned about
    the indenter's direction; its skin faces the indenter. All effects of the scene act, as in
    `simulate`; those of an arm's joints find none, and are refused (ConfigError). chain: effects of
    presses before, of the scene as `floating` has it, to go on with in place of fresh ones of the
    seed. Raises RecordingError without points, for points nowhere near the body, or for forces that
    are not positive.
    """
    check_type(Scene, scene, "what is pressed")
    world = floating(scene)
    where = check_vectors("points to press", points, error=RecordingError)
    if not len(where):
        raise RecordingError("nothing to press", remedy="give one contact point or more")
    hit, count = scene.body.closest(where), len(where)
    _near(hit.distance)
    forces = _forces(scene.law.force_reference if force is None else force, count)
    frames = _at_rest(world, hit, forces, np.broadcast_to(spin, count))
    chain = chain or effect_chain(world, seed)
    size = max(int(FRAME_CELLS / len(scene.skin)), 1)
    batches = [
        sensor_tables(world, frames.rows(slice(k, k + size)), chain) for k in range(0, count, size)
    ]
    contacts, readings = (pa.concat_tables(part) for part in zip(*batches, strict=True))
    metadata = header(scene) | {
        "provenance": provenance(scene=scene.name, seed=seed, presses=count)
    }
    return Recording(contacts, readings, metadata)


def floating(scene: Scene) -> Scene:
    """The scene as presses have it: the body moves freely, without the arm."""
    return scene.with_(loop=replace(scene.loop, mode="quasi_static"))


def _forces(force: ArrayLike, count: int) -> Array:
    """The forces (count,) of as many presses. Raises RecordingError."""
    given = check_array("forces of presses", force, error=RecordingError)
    if given.shape not in ((), (count,)):
        raise RecordingError(
            "the forces are not one a press", value=f"shape {given.shape}", limit=f"({count},)"
        )
    bad = given[~((given > 0) & np.isfinite(given))]
    if bad.size:
        raise RecordingError("a press needs a force", value=f"{bad[0]:g} N", limit="above 0 N")
    return np.array(np.broadcast_to(given, count))


def _near(distance: Array) -> None:
    """Refuse points to press that are nowhere near the surface: `distance` (m,), m, from it."""
    typical = float(np.median(np.abs(distance)))
    if not typical <= FAR_OFF:
        raise RecordingError(
            "the points to press are not on the body",
            value=f"typically {typical:.3g} m off its surface",
            limit=f"{FAR_OFF} m",
            remedy="give them in m, in the body's frame",
        )


def _at_rest(scene: Scene, hit: Closest, forces: Array, spin: Array) -> Frames:
    """Frames at contacts (m), pressed by forces (m,), N, the body turned by `spin` (m,), rad."""
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
    time = APART * np.arange(float(len(forces)))
    q = np.concatenate([place, quaternion(turned)[:, [3, 0, 1, 2]]], axis=1)
    return frames_at(scene, time, hit.point, hit.normal, forces, centres, q)
