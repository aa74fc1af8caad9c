"""The closed loop as a machine: its state, the face it runs on, and the hop to the next face."""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter

import numpy as np

from ..errors import ReachError, SimulationError
from ..geometry.body import Body
from ..se3 import Array
from .step import Blocks, Loop

BLOCK = 32
"""Steps a call: long against the call's cost, short against a face's crossing."""
SPARE = 0.25
"""How far, in barycentric weight, the foot may leave its face before the block is cut short."""


@dataclass(frozen=True)
class Steps:
    """A run of consecutive steps: times (k,), joint states (k, n), outputs (k, m), phase."""

    time: Array
    q: Array
    outputs: Array
    phase: int


class Machine:
    """State of the closed loop, and the face whose patch it runs on.

    Starts at rest at joint angles `start` (n,) with the foot near `point` (3,), body frame.
    """

    def __init__(self, body: Body, loop: Loop, start: Array, point: Array) -> None:
        self.body, self.loop, n = body, loop, loop.joints
        self.blocks = Blocks(loop, BLOCK)
        self.steps, self.seconds = 0, 0.0
        self.blocks.state[:n] = start
        hit = self.body.closest(point[None])
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
