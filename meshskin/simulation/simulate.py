"""Simulate an exploration: the arm presses the skinned body on the indenter and moves over it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from .. import effects
from ..core.arguments import check_type
from ..core.errors import ConfigError, SkinError
from ..core.provenance import provenance
from ..core.se3 import Array, inverse
from ..exploration.path import Path as ExplorationPath
from ..exploration.path import start_configuration
from ..exploration.plan import plan_exploration
from ..recording.recording import Recording, RecordingWriter
from ..robot.arm import Arm
from ..scene.scene import Scene
from . import stability
from .closed_loop_model import ClosedLoopModel
from .quasi_static import start as body_state
from .readout import FRAME_CELLS, contact_frames, effect_chain, header, sensor_tables
from .rollout import LENGTHS
from .simulator import Simulator
from .state_machine import PHASES, ExplorationStateMachine, PhaseSettings
from .steps import Steps
from .track import Track

BODY = ("x", "y", "z", "qw", "qx", "qy", "qz")
"""Columns of the body's pose, where there is no arm."""

Progress = Callable[[str, int, int], None]
"""progress(stage, done, total)"""


def simulate(
    scene: Scene,
    seed: int = 0,
    *,
    path: ExplorationPath | None = None,
    out: str | Path | None = None,
    progress: Progress | None = None,
    chain: effects.EffectPipeline | None = None,
) -> Recording:
    """Run the scene's exploration and record it.

    seed: of every random stream. path: of a plan (`explore`), to follow instead of the scene's own
    exploration. out: stream the recording to these files and read it back from there, instead of
    holding it in memory. progress(stage, done, total) is called as it goes.
    chain: effects of a run before, to go on with in place of fresh ones of the seed.
    Raises ReachError if the arm cannot follow the path, SimulationError if the loop fails,
    ConfigError for a scene whose budget has not decided what is on.
    """
    check_type(Scene, scene, "what is simulated")
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
    metadata = _metadata(scene, seed)
    metadata["unreachable"] = {str(k): why for k, why in path.unreachable.items()}
    if out is not None:
        with RecordingWriter(out, metadata) as writer:
            for contacts, readings, motion in batches:
                writer.write(contacts=contacts, readings=readings, motion=motion)
            writer.metadata |= _performance(machine)
        return Recording.load(out)
    tables = [pa.concat_tables(part) for part in zip(*batches, strict=True)]
    metadata |= _performance(machine)
    return Recording(tables[0], tables[1], metadata, tables[2])


def prepare(
    scene: Scene, taxels: Array | None = None, path: ExplorationPath | None = None
) -> tuple[Simulator, ExplorationPath]:
    """The machine at the start of the scene's exploration, and the path that it will follow.

    taxels (n, 3): read these at every step; path: follow this one instead. Raises ReachError if
    the arm cannot follow the path, ConfigError for a path of other steps than the loop's, SkinError
    for a skin that lies off the body.
    """
    quasi_static = scene.loop.mode == "quasi_static"
    _check(scene, path)
    loop = closed_loop(scene)
    path = plan_exploration(scene).path if path is None else path
    start = start_configuration(scene, path)
    if quasi_static:
        start, rest = body_state(start), body_state(path.poses[0])
    else:
        rest = loop.arm.inverse_kinematics(path.poses[:1] @ inverse(scene.mount_pose), start)[0]
    machine = Simulator(
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


def _check(scene: Scene, path: ExplorationPath | None) -> None:
    if path is not None and not isinstance(path, ExplorationPath):
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
    if off > (reach := scene.rig.sensing_radius):
        raise SkinError(
            "the skin lies off the body: no contact would be felt",
            value=f"{1e3 * off:.3g} mm at the nearest taxel",
            limit=f"{1e3 * reach:.3g} mm",
            remedy="put it on with skin.onto(body), or look at the units of both",
        )


def closed_loop(scene: Scene) -> ClosedLoopModel:
    """What the step of a scene's closed loop is made of."""
    return ClosedLoopModel(
        arm=_loaded_arm(scene),
        mount=scene.mount_pose,
        indenter_position=np.array(scene.indenter.position),
        indenter_radius=scene.indenter.radius,
        indenter_direction=scene.indenter.axis,
        effective_modulus=scene.material.effective_modulus,
        law=scene.law,
        dt=scene.loop.dt,
        integrator=scene.loop.integrator,
        mode=scene.loop.mode,
        contact=scene.model,
        delay=scene.loop.delay_steps,
    )


def _performance(machine: Simulator) -> dict[str, Any]:
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
    """What a recording says of itself before the loop has run."""
    return header(scene) | {
        "dt_s": scene.loop.dt,
        "provenance": provenance(
            seed=seed, scene=scene.name, effects=[repr(effect) for effect in scene.effects]
        ),
    }


def run(
    scene: Scene, machine: Simulator, path: ExplorationPath, progress: Progress | None = None
) -> Iterator[Steps]:
    """Run the closed loop over the path. Yields the steps as they come."""
    tracks = [Track.of(segment, scene.body.surface) for segment in path.segments]
    way = scene.exploration
    manner = PhaseSettings(way.standoff, way.settle, way.approach_ramp)
    explorer = ExplorationStateMachine(machine, tracks, manner, path.postures)
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
    scene: Scene, chain: effects.EffectPipeline, loop: ClosedLoopModel, runs: Iterator[Steps]
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


def _motion_table(scene: Scene, loop: ClosedLoopModel, batch: Sequence[Steps]) -> pa.Table:
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
