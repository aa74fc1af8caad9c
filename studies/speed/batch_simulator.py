"""Many episodes of one closed loop at once: for parameter studies and for sampling a path.

The episodes share the body and the path. Each starts at its own row of the path and may have its
own parameters (modulus, gains, ...).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from point_readings import PointReadings

from meshskin.core.arrays import Array
from meshskin.core.errors import SimulationError
from meshskin.geometry.body import Body
from meshskin.simulation.closed_loop_model import ANCHOR, ClosedLoopModel, state_of_pose
from meshskin.simulation.integrators import step
from meshskin.simulation.machine_code import PATCH, machine_code
from meshskin.simulation.rollout import bind
from meshskin.simulation.track import (
    FACE_MARGIN,
    IDENTITY_MAP,
    Track,
    face_maps,
    face_margin,
    map_foot,
    reference_poses,
)


class BatchSimulator:
    """State of `count` episodes.

    rows (count,): where each starts on the track; starts (count, n): joint angles there, not needed
    without an arm; parameters (count, 9): rows of Parameters, by default the loop's own;
    `compile_`: see machine_code; taxels (n, 3), body frame, m: read them all at every step.
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
        taxels: Array | None = None,
    ) -> None:
        self.body, self.loop, self.track = body, loop, track
        self.rows = np.array(rows, dtype=np.intp)
        count, function = len(self.rows), step(loop)
        references = track.references[self.rows]
        if starts is None:
            starts = state_of_pose(reference_poses(references))
        own = np.tile(loop.parameters.values, (count, 1)) if parameters is None else parameters
        self.state = np.zeros((count, function.size1_in(0)))
        self.references = np.array(references)
        self.maps = np.tile(IDENTITY_MAP, (count, 1))
        self.parameters = np.array(own, dtype=float)
        self.next = np.zeros_like(self.state)
        self.outputs = np.zeros((count, function.size1_out(1)))
        self.faces = np.array(track.faces[self.rows])
        self._code = machine_code(loop, body.surface.patches, compile_, 0.0)
        if self._code is None:
            self._anchors, self._anchor_faces = np.zeros((count, ANCHOR)), np.full(count, -1)
            self._buffer, self._call = bind(
                function.map(count),
                (self.state, self.references, self._anchors, self.parameters),
                (self.next, self.outputs),
            )
        self._reader = None
        if taxels is not None:
            self._reader = PointReadings(loop, taxels, np.float32, self._code is not None)
        self.readings = None if taxels is None else np.zeros((count, len(taxels)), np.float32)
        """Point pressures (count, taxels) of the last step, Pa, where they were asked for."""
        self.steps = 0
        self.state[:, : starts.shape[1]] = starts
        self._locate(np.arange(count), loop.indenter_centres(loop.body_poses(starts)))
        self._off_path = self.faces != track.faces[self.rows]

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
        self.maps[:] = IDENTITY_MAP
        new = np.flatnonzero((faces != self.faces) & ~self._off_path)
        if len(new):
            self.maps[new] = face_maps(self.body.surface, self.faces[new], faces[new])
            self.faces[new] = faces[new]
        self._run()
        if not np.isfinite(self.next.sum() + self.outputs.sum()):
            raise self._diverged()
        self.state[:] = self.next
        margin = face_margin(self.next[:, -2:])
        if margin.min() < -FACE_MARGIN:
            outside = np.flatnonzero(margin < -FACE_MARGIN)
            self._off_path[outside] = True
            self._locate(outside, self._contact_centres(outside))
        if self._off_path.any():
            self._rejoin(faces)
        if self._reader is not None:
            self._reader(self.outputs, self.readings)
        self.steps += 1
        self.rows += 1
        return self.outputs

    def _run(self) -> None:
        """One step of every episode, from `state` to `next`."""
        if self._code is not None:
            self._code.steps(
                self.state, self.next, self.references, self.faces, self.maps, self.parameters,
                self.outputs,
            )  # fmt: skip
            return
        new = np.flatnonzero(self._anchor_faces != self.faces)
        self._anchor_faces[new] = self.faces[new]
        patches = self.body.surface.patches[self.faces[new]].swapaxes(1, 2)
        self._anchors[new, :PATCH] = patches.reshape(len(new), PATCH)
        self._anchors[:, PATCH:] = self.maps
        self._call()

    def _locate(self, which: NDArray[np.intp], centres: Array) -> None:
        """Anchor some episodes at the foot point of the indenter's centre (k, 3), body frame."""
        hit = self.body.closest(centres, face=self.faces[which])
        self.state[which, -2:] = hit.uv
        self.faces[which] = hit.face

    def _rejoin(self, faces: NDArray[np.intp]) -> None:
        """Use the path's faces (count,) again for episodes whose foot point lies well on them."""
        out = np.flatnonzero(self._off_path)
        maps = face_maps(self.body.surface, self.faces[out], faces[out])
        margin = face_margin(map_foot(maps, self.state[out, -2:]))
        self._off_path[out] = margin < -FACE_MARGIN / 2

    def _contact_centres(self, which: NDArray[np.intp]) -> Array:
        """The indenter's centre (k, 3), body frame, by the outputs of some episodes."""
        rows, outputs = self.loop.outputs, self.outputs[which]
        gap = self.loop.indenter_radius - outputs[:, rows["depth"]]
        return outputs[:, rows["point"]] + gap * outputs[:, rows["normal"]]

    def _diverged(self) -> SimulationError:
        finite = np.isfinite(np.hstack([self.next, self.outputs])).all(axis=1)
        k = int(np.argmin(finite))
        return SimulationError(
            f"episode {k} diverged at t = {self.steps * self.loop.dt:.4f} s, "
            f"state = {np.round(self.state[k], 4).tolist()}",
            value=f"dt = {self.parameters[k, 0]} s",
            remedy="set a smaller loop.dt_ms or lower gains",
        )
