"""Simulate an exploration: the arm presses the skinned body on the indenter and moves over it.

A scene passes through: `prepare` (path and Simulator at its start), `run` (Steps of the closed
loop), readout.contact_frames (Frames of contacts) and readout.sensor_tables (the recording).
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from .. import effects
from ..core import arrow
from ..core.arguments import check_integer, check_type
from ..core.errors import ConfigError, PlaceError, ReachError, SkinError, warn_left_out
from ..core.progress import Progress, Stage
from ..core.provenance import provenance
from ..core.se3 import inverse
from ..exploration.left_out import GIVEN_UP, without_parts
from ..exploration.path import Path as ExplorationPath
from ..exploration.path import start_configuration
from ..exploration.plan import plan_exploration
from ..recording.recording import Recording
from ..recording.recording_files import RecordingWriter
from ..scene.scene import Scene
from . import stability
from .closed_loop_model import ClosedLoopModel, state_of_pose
from .readout import FRAME_CELLS, contact_frames, effect_pipeline, recording_metadata, sensor_tables
from .response import describe_departure
from .rollout import LENGTHS, Steps
from .simulator import Simulator
from .state_machine import PHASES, ExplorationStateMachine
from .static_contacts import press_path
from .track import Track

BODY_COLUMNS = ("x", "y", "z", "qw", "qx", "qy", "qz")
"""Columns of the body's pose in the motion table, where there is no arm."""
MAX_BATCH = 8192
"""Most steps of the closed loop whose tables are made at once: enough to spread the overhead of the
tables, and some MB of memory."""


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

    seed: of every random stream. path: the path of a plan (`explore`), to follow instead of the
    scene's own exploration. out: stream the recording to these files and read it back from there,
    instead of holding it in memory. progress(stage, done, total) is called during the run. chain:
    the effects of an earlier run, to continue instead of new ones of the seed. A carried indenter
    is pressed once at each contact of the plan, at rest at the plan's force. Warns where the
    contact force leaves its reference after settling (`response.describe_departure`), where parts
    of the path are given up, and where taxels are not covered (LeftOutWarning); the recording's
    metadata hold their ids with the reasons (`unreachable`; of parts that were given up, the
    reason begins with "given up"), and the reason of each such part (`given_up`). Raises ReachError
    if the arm cannot follow the path, SimulationError if the loop fails, ConfigError for a scene
    whose budget has not been resolved.

    >>> scene = ms.Scene.load("sphere_noisy")
    >>> recording = ms.simulate(scene, seed=1)
    >>> calibration = ms.calibrate(recording, belief=scene.belief())
    >>> error = np.linalg.norm(calibration.positions - scene.skin.positions, axis=1)
    >>> bool(1e3 * error.mean() < 0.02), calibration.verdict.level  # mm
    (True, 'PASS')
    """
    check_type(Scene, scene, "what is simulated")
    check_integer("seed", seed, least=0)
    if scene.budget is not None:
        raise ConfigError(
            f"the budget of the scene {scene.name} has not been resolved into effects",
            value=f"a budget of {1e3 * scene.budget:g} mm",
            remedy="simulate ms.budget(scene).scene, or scene.with_(budget=None)",
        )
    if scene.indenter.carried_by is not None:
        recording = _pressed(scene, seed, path or plan_exploration(scene).path, out, chain)
        warn_left_out("covered", recording.metadata["unreachable"].values(), len(scene.skin))
        return recording
    planning = Stage(progress, "plan", 1)
    simulator, path = prepare(scene, path=path)
    planning.end()
    steps = run(scene, simulator, path, progress)
    if out is not None:
        batches = _tables(scene, chain or effect_pipeline(scene, seed), simulator.loop, steps)
        with RecordingWriter(out, _metadata(scene, path, seed)) as writer:
            for contacts, readings, motion in batches:
                writer.write(contacts=contacts, readings=readings, motion=motion)
            writer.metadata |= _performance(scene, simulator, path)
        recording = Recording.load(out)
    else:
        recording = record_steps(scene, simulator, path, steps, seed, chain)
    for words in filter(None, (describe_departure(recording), _given_up(recording))):
        warnings.warn(words, stacklevel=2)
    warn_left_out("covered", recording.metadata["unreachable"].values(), len(scene.skin))
    return recording


def _given_up(recording: Recording) -> str:
    """How many parts of the path were given up, and why the first one; "" if none was."""
    reasons = recording.metadata["given_up"]
    if not reasons:
        return ""
    count = f"{len(reasons)} parts of the path were" if reasons[1:] else "1 part of the path was"
    return f"{count} given up: {reasons[0]}"


def record_steps(
    scene: Scene,
    simulator: Simulator,
    path: ExplorationPath,
    steps: Iterable[Steps],
    seed: int,
    chain: effects.EffectPipeline | None = None,
) -> Recording:
    """The recording of the steps of a simulator along a path; seed and chain as of `simulate`."""
    batches = _tables(scene, chain or effect_pipeline(scene, seed), simulator.loop, steps)
    contacts, readings, motion = (pa.concat_tables(part) for part in zip(*batches, strict=True))
    metadata = _metadata(scene, path, seed) | _performance(scene, simulator, path)
    return Recording(contacts, readings, metadata, motion)


def _metadata(scene: Scene, path: ExplorationPath, seed: int) -> dict[str, Any]:
    """What a recording says of its scene."""
    return recording_metadata(scene) | {
        "dt_s": scene.loop.dt,
        "provenance": provenance(
            seed=seed, scene=scene.name, effects=[repr(effect) for effect in scene.effects]
        ),
        "unreachable": _unreachable(path),
    }


def _pressed(
    scene: Scene,
    seed: int,
    path: ExplorationPath,
    out: str | Path | None,
    chain: effects.EffectPipeline | None,
) -> Recording:
    """The recording of a carried indenter, pressed once at each row of the path; no motion."""
    _check(scene, path)
    recording = press_path(scene, path, seed, chain)
    facts: dict[str, Any] = {"unreachable": _unreachable(path)}
    if path.forces is not None:
        facts["forces_n"] = np.unique(path.forces).tolist()
    recording = replace(recording, metadata=recording.metadata | facts)
    if out is not None:
        recording.save(out)
    return recording


def _unreachable(path: ExplorationPath) -> dict[str, str]:
    """The taxels that a path leaves out, and why, as metadata hold them."""
    return {str(taxel): reason for taxel, reason in path.unreachable.items()}


def prepare(scene: Scene, path: ExplorationPath | None = None) -> tuple[Simulator, ExplorationPath]:
    """The simulator at the start of the scene's exploration, and the path that it will follow.

    path: follow this one instead of the scene's own. Raises ReachError if the arm cannot follow the
    path, ConfigError for a path with another step than the loop's, SkinError for a skin off the
    body, SimulationError for a step that is too long.
    """
    _check(scene, path)
    if scene.indenter.carried_by is not None:
        raise ConfigError(
            "a carried indenter is pressed contact by contact, without a closed loop",
            value=f'indenter.carried_by = "{scene.indenter.carried_by}"',
            remedy="plan, simulate and calibrate it, or leave carried_by out",
        )
    loop = ClosedLoopModel.of(scene)
    path = plan_exploration(scene).path if path is None else path
    start = start_configuration(scene, path)
    if scene.loop.mode == "quasi_static":
        start, rest = state_of_pose(start), state_of_pose(path.poses[0])
    else:
        rest = loop.arm.inverse_kinematics(path.poses[:1] @ inverse(scene.mount_pose), start)[0]
    simulator = Simulator(
        scene.body, loop, start, path.points[0], compile_=scene.loop.compile, steps=len(path.points)
    )
    at_rest = path.references[0] * ([1.0] * 12 + [0.0] * 6)
    stability.check_step(simulator, rest, at_rest)
    simulator.touch_error = partial(stability.touch_error, simulator, rest, at_rest)
    return simulator, path


def _check(scene: Scene, path: ExplorationPath | None) -> None:
    """Raise ConfigError for a path unfit for the loop, SkinError for a skin off the body."""
    if path is not None and not isinstance(path, ExplorationPath):
        raise ConfigError("path must be a Path", value=type(path).__name__,
                          remedy="give the path of a plan: plan.path")  # fmt: skip
    if path is not None and abs(path.dt - scene.loop.dt) > 1e-6 * scene.loop.dt:
        raise ConfigError(
            "the path has another step than the loop",
            value=f"{1e3 * path.dt:g} ms",
            limit=f"{1e3 * scene.loop.dt:g} ms",
            remedy="plan it with dt=scene.loop.dt",
        )
    distance = float(np.abs(scene.body.closest(scene.skin.positions).distance).min())
    if distance > (reach := scene.rig.sensing_radius):
        raise SkinError(
            "the skin is not on the body: no taxel would respond to a contact",
            value=f"{1e3 * distance:.3g} mm at the nearest taxel",
            limit=f"{1e3 * reach:.3g} mm",
            remedy="project it with skin.onto(body), or check the units of both",
        )


def run(
    scene: Scene, simulator: Simulator, path: ExplorationPath, progress: Progress | None = None
) -> Iterator[Steps]:
    """Run the closed loop over the path. Yields the steps as they are made."""
    tracks = [Track.of(segment, scene.body.surface) for segment in path.segments]
    machine = ExplorationStateMachine(
        simulator, tracks, scene.exploration, path.postures, path.forces
    )
    for steps in machine.run():
        yield steps
        if progress is not None:
            progress("simulate", machine.done, len(path.points))


def _performance(scene: Scene, simulator: Simulator, path: ExplorationPath) -> dict[str, Any]:
    """Rate of the loop, estimated error of the force, steps at each joint's torque limit, why
    parts of the path were given up, and the taxels that were not reached without them."""
    names = simulator.loop.arm.joint_names[: simulator.loop.joints]
    parts = [(part.place, part.rows, _why(part.error)) for part in simulator.given_up]
    lost = without_parts(scene.skin, scene.rig.sensing_radius, path, parts) if parts else {}
    return {
        "unreachable": _unreachable(path) | {str(taxel): why for taxel, why in lost.items()},
        "steps_per_second": simulator.steps_per_second,
        "force_error": simulator.touch_error() if simulator.touch_error else None,
        "given_up": [str(part) for part in simulator.given_up],
        "torque_limited_steps": dict(zip(names, simulator.saturated.tolist(), strict=True)),
    }


def _why(error: PlaceError | ReachError) -> str:
    """Why a part of the path was given up, without where and when, as the reason of its taxels."""
    return "; ".join(filter(None, (f"{GIVEN_UP}{error.what}", error.remedy)))


def _tables(
    scene: Scene, pipeline: effects.EffectPipeline, loop: ClosedLoopModel, steps: Iterable[Steps]
) -> Iterator[tuple[pa.Table, pa.Table, pa.Table]]:
    """Tables of contacts, readings and motion, in batches, from the steps."""
    frames = FRAME_CELLS / max(len(scene.skin.ids), 1)
    size = int(np.clip(frames * scene.frame_steps, LENGTHS[0], MAX_BATCH))
    before = 0
    for batch in _batches(steps, size):
        contacts, readings = sensor_tables(
            scene, contact_frames(scene, loop, batch, before), pipeline
        )
        yield contacts, readings, _motion_table(scene, loop, batch)
        before += sum(len(s.time) for s in batch)


def _batches(steps: Iterable[Steps], size: int) -> Iterator[Sequence[Steps]]:
    """Steps gathered to about `size` steps."""
    batch: list[Steps] = []
    for part in steps:
        batch.append(part)
        if sum(len(s.time) for s in batch) >= size:
            yield batch
            batch = []
    if batch:
        yield batch


def _motion_table(scene: Scene, loop: ClosedLoopModel, batch: Sequence[Steps]) -> pa.Table:
    """One row a step: time, phase, force, reference, depth, configuration and torques."""
    outputs, rows = np.concatenate([s.outputs for s in batch]), loop.outputs
    time = np.concatenate([s.time for s in batch])
    q = np.concatenate([s.q for s in batch])
    phase = np.repeat([s.phase for s in batch], [len(s.time) for s in batch]).astype(np.int8)
    columns = {
        "time": time,
        "phase": pa.DictionaryArray.from_arrays(arrow.column(phase), arrow.texts(PHASES)),
        "force": outputs[:, rows["force"].start],
        "reference": np.repeat([s.reference for s in batch], [len(s.time) for s in batch]),
        "depth": outputs[:, rows["depth"].start],
    }
    names = [f"q{k + 1}" for k in range(loop.joints)] or BODY_COLUMNS
    columns |= dict(zip(names, q.T, strict=True))
    columns |= {f"tau{k + 1}": c for k, c in enumerate(outputs[:, rows["torque"]].T)}
    return arrow.table(columns)
