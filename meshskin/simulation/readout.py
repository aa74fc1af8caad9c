"""The skin of a scene, read: the frames of its contacts, and what is recorded of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from .. import effects
from ..core.se3 import Array, quaternion
from ..effects.frames import Frames
from ..recording.recording import CONTACTS, HEADING, READINGS, Recording

if TYPE_CHECKING:
    from ..scene.scene import Scene
    from .closed_loop_model import ClosedLoopModel
    from .steps import Steps

FRAME_CELLS = 2e6
"""Largest number of pressures (frames times taxels) held at once."""


def effect_chain(scene: Scene, seed: int) -> effects.EffectPipeline:
    """The scene's effects on frames that follow one another."""
    return effects.EffectPipeline.from_effects(
        scene.effects, scene.context(seed), scene.reading_model
    )


def contact_frames(
    scene: Scene, loop: ClosedLoopModel, batch: Sequence[Steps], before: int = 0
) -> Frames:
    """The contacts when the skin is read, among consecutive steps that follow `before` others.

    Those in which the contact model does not hold are left out: what would be read is not known.
    """
    outputs, rows = np.concatenate([s.outputs for s in batch]), loop.outputs
    frame = (before + np.arange(len(outputs))) % scene.frame_steps == 0
    frame &= outputs[:, rows["force"].start] > 0
    outputs = outputs[frame]
    time = np.concatenate([s.time for s in batch])[frame]
    q = np.concatenate([s.q for s in batch])[frame]
    points, normals = outputs[:, rows["point"]], outputs[:, rows["normal"]]
    centres = points + (scene.indenter.radius - outputs[:, rows["depth"]]) * normals
    frames = frames_at(scene, time, points, normals, outputs[:, rows["force"].start], centres, q)
    return frames.rows(scene.invalid_reasons(frames.curvature) == "")


def frames_at(
    scene: Scene, time: Array, points: Array, normals: Array, force: Array, centres: Array, q: Array
) -> Frames:
    """The frames of m contacts, their columns as in Frames."""

    def closest_point(moved: Array) -> tuple[Array, Array]:
        hit = scene.body.closest(moved)
        return hit.point, hit.normal

    hit = scene.body.closest(points if len(time) else np.zeros((1, 3)))
    return Frames(
        time=time,
        points=points,
        normals=normals,
        force=force,
        centres=centres,
        curvature=hit.curvature[: len(time)],
        directions=hit.direction[: len(time)],
        q=q,
        closest_point=closest_point,
    )


def sensor_tables(
    scene: Scene, frames: Frames, chain: effects.EffectPipeline
) -> tuple[pa.Table, pa.Table]:
    """Contacts and readings as they are recorded."""
    recorded = chain.record(frames)
    columns = (recorded.time, *recorded.points.T, *recorded.normals.T, recorded.force)
    contacts = pa.Table.from_arrays([pa.array(c) for c in columns], schema=CONTACTS)
    headings = np.zeros((0, 4))
    if len(frames):
        headings = quaternion(scene.body_pose(frames.q)[:, :3, :3])[:, [3, 0, 1, 2]]
    for name, column in zip(HEADING, headings.T, strict=True):
        contacts = contacts.append_column(name, pa.array(column))
    if not len(frames):
        return contacts, READINGS.empty_table()
    pressures = chain.read(frames, scene.skin.poses)
    row, col = np.nonzero(pressures > scene.threshold)
    ids = np.asarray(scene.skin.ids, dtype=np.int32)[col]
    readings = pa.Table.from_arrays(
        [pa.array(frames.time[row]), pa.array(ids), pa.array(pressures[row, col])],
        schema=READINGS,
    )
    return contacts, readings


def header(scene: Scene) -> dict[str, Any]:
    """What a recording of this scene says of its skin and readout."""
    return {
        "scene": scene.name,
        "taxel_ids": np.asarray(scene.skin.ids).tolist(),
        "disc_radius_m": scene.skin.disc_radius,
        "threshold_pa": scene.threshold,
        "force_reference_n": scene.law.force_reference,
    }


def recorded(scene: Scene, frames: Frames, chain: effects.EffectPipeline) -> Recording:
    """The recording of these frames alone."""
    return Recording(*sensor_tables(scene, frames, chain), header(scene))
