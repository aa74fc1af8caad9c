"""The readout of a scene's skin: from steps to frames of contacts, from frames to a recording."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from .. import effects
from ..core import arrow
from ..core.arrays import Array
from ..core.se3 import quaternion
from ..effects.frames import Frames
from ..recording.recording import CONTACT_SCHEMA, QUATERNION, READING_SCHEMA, Recording

if TYPE_CHECKING:
    from ..scene.scene import Scene
    from .closed_loop_model import ClosedLoopModel
    from .rollout import Steps

FRAME_CELLS = 2e6
"""Largest number of pressures (frames times taxels) held at once: 16 MB an array."""


def effect_pipeline(scene: Scene, seed: int) -> effects.EffectPipeline:
    """The scene's effects, for frames that follow one another."""
    return effects.EffectPipeline.from_effects(
        scene.effects, scene.context(seed), scene.reading_model
    )


def contact_frames(
    scene: Scene, loop: ClosedLoopModel, batch: Sequence[Steps], before: int = 0
) -> Frames:
    """The contacts at the times when the skin is read, among consecutive steps.

    before: number of steps of the run before these. Contacts that are outside the contact model's
    range at their own force are left out: the reading of the skin is not defined there.
    """
    outputs, rows = np.concatenate([s.outputs for s in batch]), loop.outputs
    frame = (before + np.arange(len(outputs))) % scene.frame_steps == 0
    frame &= outputs[:, rows["force"].start] > 0
    outputs = outputs[frame]
    points, normals = outputs[:, rows["point"]], outputs[:, rows["normal"]]
    frames = make_frames(
        scene,
        time=np.concatenate([s.time for s in batch])[frame],
        points=points,
        normals=normals,
        force=outputs[:, rows["force"].start],
        centres=points + (scene.indenter.radius - outputs[:, rows["depth"]]) * normals,
        q=np.concatenate([s.q for s in batch])[frame],
    )
    valid = scene.model.is_valid(
        force=frames.force,
        curvature=frames.curvature,
        indenter_radius=scene.indenter.radius,
        effective_modulus=scene.material.effective_modulus,
    )
    return frames.rows(np.asarray(valid))


def make_frames(
    scene: Scene, time: Array, points: Array, normals: Array, force: Array, centres: Array, q: Array
) -> Frames:
    """The frames of m contacts on the scene's body; the columns are those of Frames."""

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
    scene: Scene, frames: Frames, pipeline: effects.EffectPipeline
) -> tuple[pa.Table, pa.Table]:
    """The tables of contacts and readings as they are recorded."""
    recorded = pipeline.record(frames)
    columns = (recorded.time, *recorded.points.T, *recorded.normals.T, recorded.force)
    contacts = pa.Table.from_arrays([arrow.column(c) for c in columns], schema=CONTACT_SCHEMA)
    headings = np.zeros((0, 4))
    if len(frames):
        headings = quaternion(scene.body_pose(recorded.q)[:, :3, :3])[:, [3, 0, 1, 2]]
    for name, column in zip(QUATERNION, headings.T, strict=True):
        contacts = contacts.append_column(name, arrow.column(column))
    schema = _readings_schema(scene.skin.ids)
    if not len(frames):
        return contacts, schema.empty_table()
    pressures = pipeline.read(frames, scene.skin.poses)
    row, col = np.nonzero(pressures > scene.threshold)
    taxels = arrow.column(np.asarray(scene.skin.ids)[col], schema.field("taxel").type)
    readings = pa.Table.from_arrays(
        [arrow.column(frames.time[row]), taxels, arrow.column(pressures[row, col])], schema=schema
    )
    return contacts, readings


def _readings_schema(ids: Any) -> pa.Schema:
    """READING_SCHEMA, with 64-bit taxel ids where 32 bits do not hold them."""
    ids, limits = np.asarray(ids), np.iinfo(np.int32)
    if not len(ids) or (limits.min <= ids.min() and ids.max() <= limits.max):
        return READING_SCHEMA
    return READING_SCHEMA.set(
        READING_SCHEMA.get_field_index("taxel"), pa.field("taxel", pa.int64())
    )


def recording_metadata(scene: Scene) -> dict[str, Any]:
    """What the metadata of a recording say about the scene's skin and readout."""
    return {
        "scene": scene.name,
        "taxel_ids": np.asarray(scene.skin.ids).tolist(),
        "disc_radius_m": scene.skin.disc_radius,
        "threshold_pa": scene.threshold,
        "force_reference_n": scene.law.force_reference,
    }


def record(scene: Scene, frames: Frames, pipeline: effects.EffectPipeline) -> Recording:
    """The recording of these frames alone."""
    return Recording(*sensor_tables(scene, frames, pipeline), recording_metadata(scene))
