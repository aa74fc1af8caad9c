"""Simulate an exploration: the arm presses the skinned body on the indenter and moves over it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from . import recording as files
from .arguments import needs
from .errors import ConfigError, SkinError
from .exploration import route, setup_of, start_of
from .motion import path as paths
from .motion import stability
from .motion.arm import Arm
from .motion.loop import Loop
from .motion.machine import Machine, Steps
from .motion.phases import PHASES, Explorer, Manner
from .motion.quasi_static import start as body_state
from .motion.stretch import LENGTHS
from .motion.track import Track
from .physics import effects
from .physics.effects.frames import Frames
from .provenance import provenance
from .recording import Recording, RecordingWriter
from .scene import Scene
from .se3 import Array, inverse, quaternion

FRAME_CELLS = 2e6
"""Largest number of pressures (frames times taxels) held at once."""
BODY = ("x", "y", "z", "qw", "qx", "qy", "qz")
"""Columns of the body's pose, where there is no arm."""

Progress = Callable[[str, int, int], None]
"""progress(stage, done, total)"""


def simulate(
    scene: Scene,
    seed: int = 0,
    *,
    path: paths.Path | None = None,
    out: str | Path | None = None,
    progress: Progress | None = None,
    chain: effects.Chain | None = None,
) -> Recording:
    """Run the scene's exploration and record it.

    seed: of every random stream. path: of a plan (`explore`), to follow instead of the scene's own
    exploration. out: stream the recording to these files and read it back from there, instead of
    holding it in memory. progress(stage, done, total) is called as it goes.
    chain: effects of a run before, to go on with in place of fresh ones of the seed.
    Raises ReachError if the arm cannot follow the path, SimulationError if the loop fails,
    ConfigError for a scene whose budget has not decided what is on.
    """
    needs(Scene, scene, "what is simulated")
    if scene.budget is not None:
        raise ConfigError(
            f"what is on in the scene {scene.name} has not been decided",
            value=f"a budget of {1e3 * scene.budget:g} mm",
            remedy="simulate ms.budget(scene).scene, or scene.with_(budget=None) as it is",
        )
    machine, path = prepare(scene, path=path)
    batches = _tables(
        scene, chain or effect_chain(scene, seed), machine.loop, run(scene, machine, path, progress)
    )
    header = _metadata(scene, seed)
    header["unreachable"] = {str(k): why for k, why in path.unreachable.items()}
    if out is not None:
        with RecordingWriter(out, header) as writer:
            for contacts, readings, motion in batches:
                writer.write(contacts=contacts, readings=readings, motion=motion)
            writer.metadata |= _performance(machine)
        return Recording.load(out)
    tables = [pa.concat_tables(part) for part in zip(*batches, strict=True)]
    header |= _performance(machine)
    return Recording(tables[0], tables[1], header, tables[2])


def prepare(
    scene: Scene, taxels: Array | None = None, path: paths.Path | None = None
) -> tuple[Machine, paths.Path]:
    """The machine at the start of the scene's exploration, and the path that it will follow.

    taxels (n, 3): read these at every step; path: follow this one instead. Raises ReachError if
    the arm cannot follow the path, ConfigError for a path of other steps than the loop's, SkinError
    for a skin that lies off the body.
    """
    quasi_static = scene.loop.mode == "quasi_static"
    _check(scene, path)
    loop = closed_loop(scene)
    path, start = route(scene) if path is None else (path, start_of(scene, path))
    if quasi_static:
        start, rest = body_state(start), body_state(path.poses[0])
    else:
        rest = loop.arm.inverse_kinematics(path.poses[:1] @ inverse(scene.mount_pose), start)[0]
    machine = Machine(
        scene.body,
        loop,
        start,
        path.points[0],
        compile_=scene.loop.compile,
        steps=len(path.points),
        taxels=taxels,
    )
    still = path.references[0] * ([1.0] * 12 + [0.0] * 6)
    stability.check(machine, rest, still)
    machine.touch_error = partial(stability.touch_error, machine, rest, still)
    return machine, path


def _check(scene: Scene, path: paths.Path | None) -> None:
    if path is not None and not isinstance(path, paths.Path):
        raise ConfigError("what is to be followed is no path", value=type(path).__name__,
                          remedy="of a plan give plan.path")  # fmt: skip
    if path is not None and abs(path.dt - scene.loop.dt) > 1e-6 * scene.loop.dt:
        raise ConfigError(
            "the path was planned for other steps than the loop's",
            value=f"{1e3 * path.dt:g} ms",
            limit=f"{1e3 * scene.loop.dt:g} ms",
            remedy="plan it with dt=scene.loop.dt",
        )
    off = float(np.abs(scene.body.closest(scene.skin.positions).distance).min())
    if off > (reach := setup_of(scene).reach):
        raise SkinError(
            "the skin lies off the body: no contact would be felt",
            value=f"{1e3 * off:.3g} mm at the nearest taxel",
            limit=f"{1e3 * reach:.3g} mm",
            remedy="put it on with skin.onto(body), or look at the units of both",
        )


def closed_loop(scene: Scene) -> Loop:
    """What the step of a scene's closed loop is made of."""
    return Loop(
        arm=_loaded_arm(scene),
        mount=scene.mount_pose,
        indenter_position=np.array(scene.indenter.position),
        indenter_radius=scene.indenter.radius,
        indenter_direction=scene.indenter.up,
        effective_modulus=scene.material.effective_modulus,
        law=scene.law,
        dt=scene.loop.dt,
        integrator=scene.loop.integrator,
        mode=scene.loop.mode,
        contact=scene.model,
        delay=scene.loop.delay_steps,
    )


def _performance(machine: Machine) -> dict[str, Any]:
    """How the loop ran: its rate, its stated error, how often each torque was at its limit."""
    names = machine.loop.arm.joint_names[: machine.loop.joints]
    return {
        "steps_per_second": machine.steps_per_second,
        "force_error": machine.touch_error() if machine.touch_error else None,
        "torque_limited_steps": dict(zip(names, machine.saturated.tolist(), strict=True)),
    }


def _loaded_arm(scene: Scene) -> Arm:
    """The arm with the body's mass at its tip."""
    if scene.payload == 0:
        return scene.arm
    mesh = scene.body.mesh
    pose = scene.mount_pose
    density = scene.payload / abs(mesh.volume)
    inertia = pose[:3, :3] @ (np.asarray(mesh.moment_inertia) * density) @ pose[:3, :3].T
    com = pose[:3, :3] @ np.asarray(mesh.center_mass) + pose[:3, 3]
    return scene.arm.with_payload(scene.payload, com, inertia)


def _metadata(scene: Scene, seed: int) -> dict[str, Any]:
    return {
        "scene": scene.name,
        "taxel_ids": np.asarray(scene.skin.ids).tolist(),
        "disc_radius_m": scene.skin.disc_radius,
        "threshold_pa": scene.threshold,
        "force_reference_n": scene.law.force_reference,
        "dt_s": scene.loop.dt,
        "provenance": provenance(
            seed=seed, scene=scene.name, effects=[repr(effect) for effect in scene.effects]
        ),
    }


def run(
    scene: Scene, machine: Machine, path: paths.Path, progress: Progress | None = None
) -> Iterator[Steps]:
    """Run the closed loop over the path. Yields the steps as they come."""
    tracks = [Track.of(place, scene.body.surface) for place in path.places]
    way = scene.exploration
    manner = Manner(way.standoff, way.settle, way.approach_ramp)
    explorer = Explorer(machine, tracks, manner, path.postures)
    for steps in explorer.run():
        yield steps
        if progress is not None:
            progress("simulate", explorer.done, len(path.points))


def _batches(runs: Iterator[Steps], size: int) -> Iterator[Sequence[Steps]]:
    """Runs of steps gathered to about `size` steps."""
    gathered: list[Steps] = []
    for steps in runs:
        gathered.append(steps)
        if sum(len(s.time) for s in gathered) >= size:
            yield gathered
            gathered = []
    if gathered:
        yield gathered


def _tables(
    scene: Scene, chain: effects.Chain, loop: Loop, runs: Iterator[Steps]
) -> Iterator[tuple[pa.Table, pa.Table, pa.Table]]:
    """Tables of contacts, readings and motion, in batches, from the steps."""
    stride = scene.frame_steps
    size = int(np.clip(FRAME_CELLS / max(len(scene.skin.ids), 1) * stride, LENGTHS[0], 8192))
    count = 0
    for batch in _batches(runs, size):
        seen = contact_frames(scene, loop, batch, count)
        count += sum(len(s.time) for s in batch)
        contacts, readings = sensor_tables(scene, seen, chain)
        yield contacts, readings, _motion_table(scene, loop, batch)


def effect_chain(scene: Scene, seed: int) -> effects.Chain:
    """The scene's effects on frames that follow one another."""
    return effects.Chain.of(scene.effects, scene.context(seed), scene.ideal)


def contact_frames(scene: Scene, loop: Loop, batch: Sequence[Steps], before: int = 0) -> Frames:
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
    return frames.rows(scene.refusals(frames.curvature) == "")


def frames_at(
    scene: Scene, time: Array, points: Array, normals: Array, force: Array, centres: Array, q: Array
) -> Frames:
    """The frames of m contacts, their columns as in Frames."""

    def foot(moved: Array) -> tuple[Array, Array]:
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
        foot=foot,
    )


def sensor_tables(scene: Scene, frames: Frames, chain: effects.Chain) -> tuple[pa.Table, pa.Table]:
    """Contacts and readings as they are recorded."""
    recorded = chain.record(frames)
    columns = (recorded.time, *recorded.points.T, *recorded.normals.T, recorded.force)
    contacts = pa.Table.from_arrays([pa.array(c) for c in columns], schema=files.CONTACTS)
    headings = np.zeros((0, 4))
    if len(frames):
        headings = quaternion(scene.body_pose(frames.q)[:, :3, :3])[:, [3, 0, 1, 2]]
    for name, column in zip(files.HEADING, headings.T, strict=True):
        contacts = contacts.append_column(name, pa.array(column))
    if not len(frames):
        return contacts, files.READINGS.empty_table()
    pressures = chain.read(frames, scene.skin.poses)
    row, col = np.nonzero(pressures > scene.threshold)
    ids = np.asarray(scene.skin.ids, dtype=np.int32)[col]
    readings = pa.Table.from_arrays(
        [pa.array(frames.time[row]), pa.array(ids), pa.array(pressures[row, col])],
        schema=files.READINGS,
    )
    return contacts, readings


def _motion_table(scene: Scene, loop: Loop, batch: Sequence[Steps]) -> pa.Table:
    """Every step: time, phase, force, reference, depth, joint angles and torques."""
    outputs, rows = np.concatenate([s.outputs for s in batch]), loop.outputs
    time = np.concatenate([s.time for s in batch])
    q = np.concatenate([s.q for s in batch])
    phase = np.repeat([s.phase for s in batch], [len(s.time) for s in batch]).astype(np.int8)
    columns = {
        "time": time,
        "phase": pa.DictionaryArray.from_arrays(phase, list(PHASES)),
        "force": outputs[:, rows["force"].start],
        "reference": np.full(len(time), scene.law.force_reference),
        "depth": outputs[:, rows["depth"].start],
    }
    names = [f"q{k + 1}" for k in range(q.shape[1])]
    if not rows["torque"].stop > rows["torque"].start:
        names = list(BODY)
    columns |= dict(zip(names, q.T, strict=True))
    columns |= {f"tau{k + 1}": c for k, c in enumerate(outputs[:, rows["torque"]].T)}
    return pa.table(columns)
