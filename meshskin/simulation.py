"""Simulate an exploration: the arm presses the skinned body on the indenter and moves over it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import pyarrow as pa

from . import recording as files
from .errors import ReachError, SimulationError
from .motion import path as paths
from .motion.arm import Arm
from .motion.step import Blocks, Loop
from .physics import effects
from .physics.reading import disc_pressures
from .provenance import provenance
from .recording import Recording, RecordingWriter
from .scene import Scene
from .se3 import Array, exp_so3, inverse, log_so3, transform

BLOCK = 32
"""Steps a call: long against the call's cost, short against a face's crossing."""
SPARE = 0.25
"""How far, in barycentric weight, the foot may leave its face before the block is cut short."""
FRAME_CELLS = 2e6
"""Largest number of pressures (frames times taxels) held at once."""
HEADINGS = 8
"""World directions tried for the skin's first meridian."""
CHECKS = 400
"""Samples of the path whose joint angles are solved for each heading."""
PHASES = ("approach", "settle", "explore")

Progress = Callable[[int, int], None]


def simulate(
    scene: Scene,
    seed: int = 0,
    *,
    out: str | Path | None = None,
    progress: Progress | None = None,
) -> Recording:
    """Run the scene's exploration and record it.

    seed: of every random stream. out: stream the recording to these files and read it back from
    there, instead of holding it in memory. progress(done, total) is called in steps.
    Raises ReachError if the arm cannot follow the path, SimulationError if the loop fails.
    """
    arm = _loaded_arm(scene)
    loop = Loop(
        arm=arm,
        mount=scene.mount_pose,
        indenter_position=np.array(scene.indenter.position),
        indenter_radius=scene.indenter.radius,
        effective_modulus=scene.material.effective_modulus,
        law=scene.law,
        dt=scene.loop.dt,
    )
    path, start = reachable_path(scene, arm)
    machine = _Machine(scene, loop, start, path)
    batches = _tables(scene, seed, loop, _run(scene, machine, path, progress))
    header = _metadata(scene, seed)
    if out is not None:
        with RecordingWriter(out, header) as writer:
            for contacts, readings, motion in batches:
                writer.write(contacts=contacts, readings=readings, motion=motion)
            writer.metadata["steps_per_second"] = machine.steps_per_second
        return Recording.load(out)
    tables = [pa.concat_tables(part) for part in zip(*batches, strict=True)]
    header["steps_per_second"] = machine.steps_per_second
    return Recording(tables[0], tables[1], header, tables[2])


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


def reachable_path(scene: Scene, arm: Arm) -> tuple[paths.Path, Array]:
    """The exploration path and the joint angles (n,) at its standoff, with the best heading.

    Of the headings about the vertical, the one that stays farthest from the joint limits is taken.
    Raises ReachError with the best heading's reason if none works.
    """
    cosine = np.clip(scene.skin.normals @ scene.axis, -1.0, 1.0)
    best: tuple[float, paths.Path, Array] | None = None
    reason: ReachError | None = None
    tip_body = inverse(scene.mount_pose)
    for heading in np.arange(HEADINGS) * 2 * np.pi / HEADINGS:
        coarse = _plan(scene, cosine, heading, scene.loop.dt * 50)
        poses = coarse.poses[:: max(len(coarse.poses) // CHECKS, 1)] @ tip_body
        try:
            seed = arm.solve(poses[len(poses) // 2])
            first = arm.inverse_kinematics(_bridge(poses[len(poses) // 2], poses[0]), seed)[-1]
            q = arm.inverse_kinematics(poses, first)
            above = poses[0].copy()
            above[2, 3] += scene.exploration.standoff + scene.patch.depth
            start = arm.inverse_kinematics(above[None], first)[0]
        except ReachError as error:
            reason = reason or error
            continue
        spare = float(np.minimum(q - arm.lower, arm.upper - q).min())
        if best is None or spare > best[0]:
            best = spare, coarse, start
            best_heading = heading
    if best is None:
        raise ReachError(
            f"the arm {arm.name} cannot turn the skin over the indenter at "
            f"{tuple(round(float(x), 3) for x in scene.indenter.position)} m: {reason}",
            remedy="move indenter.position_m or change the mount",
        ) from reason
    return _plan(scene, cosine, best_heading, scene.loop.dt), best[2]


def _plan(scene: Scene, cosine: Array, heading: float, dt: float) -> paths.Path:
    return paths.plan(
        scene.body,
        scene.axis,
        float(np.arccos(cosine.min())),
        scene.exploration,
        indenter_position=np.array(scene.indenter.position),
        gap=scene.indenter.radius - scene.patch.depth,
        heading=heading,
        dt=dt,
    )


def _bridge(start: Array, goal: Array) -> Array:
    """Poses (k, 4, 4) from one to the other by a straight screw-free blend in small steps."""
    turn = log_so3(goal[:3, :3] @ start[:3, :3].T)
    count = 2 + int(np.ceil(np.linalg.norm(turn) / 0.05))
    part = np.linspace(0.0, 1.0, count)
    rotation = exp_so3(part[:, None] * turn) @ start[:3, :3]
    shift = goal[:3, 3] - start[:3, 3]
    return transform(rotation, start[:3, 3] + part[:, None] * shift)


@dataclass(frozen=True)
class Steps:
    """A run of consecutive steps: times (k,), joint states (k, n), outputs (k, m), phase."""

    time: Array
    q: Array
    outputs: Array
    phase: int


def _run(
    scene: Scene, machine: _Machine, path: paths.Path, progress: Progress | None
) -> Iterator[Steps]:
    """Run the closed loop: approach until touch, settle, explore. Yields the steps as they come."""
    loop, references = machine.loop, path.references
    hold = np.concatenate([references[0, :12], np.zeros(6)])
    settle = max(round(scene.exploration.settle / loop.dt), 1)
    patience = int(
        np.ceil((1.0 + 5 * scene.exploration.standoff / loop.law.approach_speed) / loop.dt)
    )
    total = settle + len(references)
    done = 0
    while True:
        steps = machine.advance(np.tile(hold, (BLOCK, 1)), phase=0)
        touch = np.flatnonzero(steps.outputs[:, loop.outputs["force"]] > 0)
        yield steps
        if len(touch):
            break
        done += len(steps.time)
        if done > patience:
            raise SimulationError(
                "the arm did not touch the indenter", value=f"{done * loop.dt:.2f} s of approach",
                remedy="check indenter.position_m and exploration.standoff_m",
            )  # fmt: skip
    done = 0
    while done < total:
        phase = 1 if done < settle else 2
        end = min(done + BLOCK, settle if phase == 1 else total)
        if phase == 1:
            wanted = np.tile(hold, (end - done, 1))
        else:
            wanted = references[done - settle : end - settle]
        steps = machine.advance(wanted, phase)
        yield steps
        done += len(steps.time)
        if progress is not None:
            progress(done, total)


class _Machine:
    """State of the closed loop, and the face whose patch it runs on."""

    def __init__(self, scene: Scene, loop: Loop, start: Array, path: paths.Path) -> None:
        self.body, self.loop, n = scene.body, loop, loop.joints
        self.blocks = Blocks(loop, BLOCK)
        self.steps, self.seconds = 0, 0.0
        self.blocks.state[:n] = start
        hit = self.body.closest(path.points[:1])
        self._anchor(int(hit.face[0]), hit.uv[0])

    def _anchor(self, face: int, uv: Array) -> None:
        self.face = face
        self.blocks.patch[:] = self.body.surface.patches[face].T.ravel()
        self.blocks.state[-2:] = uv

    @property
    def steps_per_second(self) -> float:
        """Steps of the closed loop in a second of running it."""
        return self.steps / self.seconds if self.seconds else 0.0

    def advance(self, references: Array, phase: int) -> Steps:
        """Run at most len(references) steps; fewer if the foot leaves its face's neighbourhood."""
        started = perf_counter()
        blocks, n = self.blocks, self.loop.joints
        blocks.references[: len(references)] = references
        blocks.references[len(references) :] = references[-1]
        before = blocks.state.copy()
        blocks.run()
        count = len(references)
        uv = blocks.states[:count, -2:]
        spare = np.minimum(uv.min(axis=1), 1.0 - uv.sum(axis=1))
        left = np.flatnonzero(~(spare >= -SPARE))
        if len(left):
            count = int(left[0]) + 1
        states = blocks.states[:count]
        outputs = blocks.outputs[:count].copy()
        self._check(states, outputs)
        q = np.concatenate([before[None, :n], states[:-1, :n]])
        time = (self.steps + np.arange(count)) * self.loop.dt
        self.steps += count
        blocks.state[:] = states[-1]
        if spare[count - 1] < 0:
            self._hop(outputs[-1])
        self.seconds += perf_counter() - started
        return Steps(time, q, outputs, phase)

    def _hop(self, output: Array) -> None:
        """Anchor the patch at the foot of the indenter's centre, found on the mesh."""
        rows = self.loop.outputs
        gap = self.loop.indenter_radius - output[rows["depth"]]
        centre = output[rows["point"]] + gap * output[rows["normal"]]
        hit = self.body.closest(centre[None], face=np.array([self.face]))
        self._anchor(int(hit.face[0]), hit.uv[0])

    def _check(self, states: Array, outputs: Array) -> None:
        """Raise SimulationError with time and state if a number is not finite or a joint is out."""
        finite = np.isfinite(states).all(axis=1) & np.isfinite(outputs).all(axis=1)
        q = states[:, : self.loop.joints]
        arm = self.loop.arm
        out = (q < arm.lower) | (q > arm.upper)
        if finite.all() and not out.any():
            return
        k = int(np.argmax(~finite | out.any(axis=1)))
        at = f"t = {(self.steps + k) * self.loop.dt:.4f} s, q = {np.round(q[k], 4).tolist()} rad"
        if not finite[k]:
            raise SimulationError(
                f"the closed loop diverged at {at}", value=f"dt = {self.loop.dt} s",
                remedy="take a smaller loop.dt_ms or lower gains",
            )  # fmt: skip
        j = int(np.argmax(out[k]))
        raise ReachError(
            f"joint {arm.joint_names[j]} left its range at {at}",
            value=f"{q[k, j]:.4f} rad",
            limit=f"{arm.lower[j]:.4f} to {arm.upper[j]:.4f} rad",
            remedy="move indenter.position_m or change the mount",
        )


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
    scene: Scene, seed: int, loop: Loop, runs: Iterator[Steps]
) -> Iterator[tuple[pa.Table, pa.Table, pa.Table]]:
    """Tables of contacts, readings and motion, in batches, from the steps."""
    context = scene.context(seed)
    acting = [
        act
        for stage in ("pressure", "transducer")
        for act in effects.build(scene.effects, context, stage)
    ]
    stride = max(round(1.0 / (scene.readout.rate * loop.dt)), 1)
    size = int(np.clip(FRAME_CELLS / max(len(scene.skin.ids), 1) * stride, BLOCK, 8192))
    rows = loop.outputs
    count = 0
    for batch in _batches(runs, size):
        time = np.concatenate([s.time for s in batch])
        outputs = np.concatenate([s.outputs for s in batch])
        frame = (count + np.arange(len(time))) % stride == 0
        count += len(time)
        frame &= outputs[:, rows["force"].start] > 0
        contacts, readings = _sensor_tables(scene, time[frame], outputs[frame], rows, acting)
        yield contacts, readings, _motion_table(scene, batch, time, outputs, rows)


def _sensor_tables(
    scene: Scene,
    time: Array,
    outputs: Array,
    rows: dict[str, slice],
    acting: Sequence[effects.Pressures],
) -> tuple[pa.Table, pa.Table]:
    """Contacts and readings of the frames at `time` (m,)."""
    points, normals = outputs[:, rows["point"]], outputs[:, rows["normal"]]
    force = outputs[:, rows["force"].start]
    contacts = pa.Table.from_arrays(
        [pa.array(c) for c in (time, *points.T, *normals.T, force)], schema=files.CONTACTS
    )
    if not len(time):
        return contacts, files.READINGS.empty_table()
    pressures = disc_pressures(
        points,
        normals,
        force,
        scene.body.closest(points).curvature,
        positions=scene.skin.positions,
        disc_radius=scene.skin.disc_radius,
        indenter_radius=scene.indenter.radius,
        effective_modulus=scene.material.effective_modulus,
    )
    for act in acting:
        pressures = act(pressures)
    row, col = np.nonzero(pressures > scene.threshold)
    ids = np.asarray(scene.skin.ids, dtype=np.int32)[col]
    readings = pa.Table.from_arrays(
        [pa.array(time[row]), pa.array(ids), pa.array(pressures[row, col])], schema=files.READINGS
    )
    return contacts, readings


def _motion_table(
    scene: Scene, batch: Sequence[Steps], time: Array, outputs: Array, rows: dict[str, slice]
) -> pa.Table:
    """Every step: time, phase, force, reference, depth, joint angles and torques."""
    q = np.concatenate([s.q for s in batch])
    phase = np.repeat([s.phase for s in batch], [len(s.time) for s in batch]).astype(np.int8)
    columns = {
        "time": time,
        "phase": pa.DictionaryArray.from_arrays(phase, list(PHASES)),
        "force": outputs[:, rows["force"].start],
        "reference": np.full(len(time), scene.law.force_reference),
        "depth": outputs[:, rows["depth"].start],
    }
    columns |= {f"q{k + 1}": c for k, c in enumerate(q.T)}
    columns |= {f"tau{k + 1}": c for k, c in enumerate(outputs[:, rows["torque"]].T)}
    return pa.table(columns)
