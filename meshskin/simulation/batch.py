"""Many episodes of one loop at once, in step: for parameter studies and for sampling a path.

The episodes share the body and the path. Each starts at a row of the path of its own and may have
parameters of its own (modulus, gains, ...).
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core.errors import SimulationError
from ..core.se3 import Array
from ..geometry.body import Body
from .closed_loop_model import ANCHOR, ClosedLoopModel
from .machine_code import PATCH, machine_code
from .point_readings import PointReadings
from .quasi_static import start as body_state
from .rollout import SPARE
from .step import step
from .track import STAY, Track, crossings, reference_poses


class Batch:
    """State of `count` episodes.

    rows (count,): where each starts on the track; starts (count, n): joint angles there, not needed
    without an arm; parameters (count, 9): rows of loop.Parameters, by default the loop's own;
    `compile_` and `steps`: see machine_code; taxels (n, 3): read them all at every step.
    """

    def __init__(
        self,
        body: Body,
        loop: ClosedLoopModel,
        track: Track,
        rows: NDArray[np.intp],
        starts: Array | None = None,
        *,
        parameters: Array | None = None,
        compile_: str = "auto",
        steps: float = 0.0,
        taxels: Array | None = None,
    ) -> None:
        self.body, self.loop, self.track = body, loop, track
        self.rows = np.array(rows, dtype=np.intp)
        count = len(self.rows)
        one = step(loop)
        references = track.references[self.rows]
        if starts is None:
            starts = np.array([body_state(pose) for pose in reference_poses(references)])
        own = np.tile(loop.parameters.values, (count, 1)) if parameters is None else parameters
        self.state = np.zeros((count, one.size1_in(0)))
        self.references = np.array(references)
        self.maps = np.tile(STAY, (count, 1))
        self.parameters = np.array(own, dtype=float)
        self.next = np.zeros_like(self.state)
        self.outputs = np.zeros((count, one.size1_out(1)))
        self.faces = np.array(track.faces[self.rows])
        self._code = machine_code(loop, body.surface.patches, compile_, steps * count)
        self._fan = _Fan(one, self) if self._code is None else None
        self._reader = None
        if taxels is not None:
            self._reader = PointReadings(loop, taxels, np.float32, self._code)
        self.readings = None if taxels is None else np.zeros((count, len(taxels)), np.float32)
        """Point pressures (count, taxels) of the last step, Pa, where they were asked for."""
        self._astray = np.zeros(count, dtype=bool)
        self.steps = 0
        self.state[:, : starts.shape[1]] = starts
        self._locate(np.arange(count), self._centres(starts))
        self._astray[:] = self.faces != track.faces[self.rows]

    def advance(self) -> Array:
        """One step of every episode; returns the outputs (count, m), valid until the next.

        An episode at the end of the track rests there. Raises SimulationError where a number is not
        finite.
        """
        track, last = self.track, len(self.track) - 1
        np.minimum(self.rows, last, out=self.rows)
        np.take(track.references, self.rows, axis=0, out=self.references, mode="clip")
        if self.rows.max() == last:
            self.references[self.rows == last, -6:] = 0.0
        faces = track.faces[self.rows]
        self.maps[:] = STAY
        new = np.flatnonzero((faces != self.faces) & ~self._astray)
        if len(new):
            self.maps[new] = crossings(self.body.surface, self.faces[new], faces[new])
            self.faces[new] = faces[new]
        self._run()
        if not np.isfinite(self.next.sum() + self.outputs.sum()):
            self._refuse()
        self.state[:] = self.next
        u, v = self.next[:, -2], self.next[:, -1]
        spare = np.minimum(np.minimum(u, v), 1.0 - u - v)
        if spare.min() < -SPARE:
            out = np.flatnonzero(spare < -SPARE)
            self._astray[out] = True
            self._locate(out, self._last_centres(out))
        if self._astray.any():
            self._rejoin(faces)
        if self._reader is not None:
            self._reader(self.outputs, self.readings)
        self.steps += 1
        self.rows += 1
        return self.outputs

    def _run(self) -> None:
        """One step of every episode, from `state` to `next`."""
        if self._fan is not None:
            self._fan.run(self.faces, self.maps)
        elif self._code is not None:
            self._code.steps(
                self.state, self.next, self.references, self.faces, self.maps, self.parameters,
                self.outputs,
            )  # fmt: skip

    def _locate(self, which: NDArray[np.intp], centres: Array) -> None:
        """Anchor some episodes at the foot of the indenter's centre (k, 3), body frame."""
        hit = self.body.closest(centres, face=self.faces[which])
        self.state[which, -2:] = hit.uv
        self.faces[which] = hit.face

    def _rejoin(self, faces: NDArray[np.intp]) -> None:
        """Episodes whose foot lies well on the path's face run over the path's faces again."""
        out = np.flatnonzero(self._astray)
        change = crossings(self.body.surface, self.faces[out], faces[out]).reshape(-1, 3, 2)
        foot = np.concatenate([self.state[out, -2:], np.ones((len(out), 1))], axis=1)
        uv = np.einsum("kij,ki->kj", change, foot)
        spare = np.minimum(uv.min(axis=1), 1.0 - uv.sum(axis=1))
        self._astray[out] = spare < -SPARE / 2

    def _centres(self, starts: Array) -> Array:
        """The indenter's centre (count, 3) in the body frames of the start."""
        if self.loop.mode == "arm":
            poses = self.loop.arm.pose(starts) @ self.loop.mount
        else:
            poses = reference_poses(self.track.references[self.rows])
        reach = self.loop.indenter_position - poses[:, :3, 3]
        return np.einsum("kji,kj->ki", poses[:, :3, :3], reach)

    def _last_centres(self, which: NDArray[np.intp]) -> Array:
        rows, out = self.loop.outputs, self.outputs[which]
        gap = self.loop.indenter_radius - out[:, rows["depth"]]
        return out[:, rows["point"]] + gap * out[:, rows["normal"]]

    def _refuse(self) -> None:
        whole = np.isfinite(np.hstack([self.next, self.outputs])).all(axis=1)
        k = int(np.argmin(whole))
        raise SimulationError(
            f"episode {k} diverged at t = {self.steps * self.loop.dt:.4f} s, "
            f"state = {np.round(self.state[k], 4).tolist()}",
            value=f"dt = {self.parameters[k, 0]} s",
            remedy="take a smaller loop.dt_ms or lower gains",
        )


class _Fan:
    """One step of all episodes, interpreted: from a batch's arrays into its `next`, `outputs`."""

    def __init__(self, one: ca.Function, batch: Batch) -> None:
        self._patches, self._faces = batch.body.surface.patches, np.full(len(batch.rows), -1)
        self._anchors = np.zeros((len(batch.rows), ANCHOR))
        buffer: Any = one.map(len(batch.rows)).buffer()
        self._buffer, self._call = buffer
        inputs: tuple[Any, ...] = (batch.state, batch.references, self._anchors, batch.parameters)
        for k, array in enumerate(inputs):
            self._buffer.set_arg(k, memoryview(array))
        results: tuple[Any, ...] = (batch.next, batch.outputs)
        for k, array in enumerate(results):
            self._buffer.set_res(k, memoryview(array))

    def run(self, faces: NDArray[np.intp], maps: Array) -> None:
        """Step on `faces` (count,), the feet carried there by `maps` (count, 6)."""
        new = np.flatnonzero(self._faces != faces)
        self._faces[new] = faces[new]
        patches = self._patches[faces[new]].swapaxes(1, 2)
        self._anchors[new, : -len(STAY)] = patches.reshape(len(new), PATCH)
        self._anchors[:, -len(STAY) :] = maps
        self._call()
