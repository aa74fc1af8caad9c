"""The closed loop as a machine: its state, the faces it runs over, and what must not happen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from time import perf_counter

import numpy as np

from ..core.errors import PlaceError, ReachError, SimulationError
from ..core.se3 import Array
from ..geometry.body import Body
from ..geometry.surface.closest_point import Closest
from ..robot.collision import EDGY
from . import transfer
from .closed_loop_model import APPROACH_SPEED, REFERENCE, ClosedLoopModel, flat_anchor
from .machine_code import machine_code
from .penetration import centres, poses, under
from .point_readings import PointReadings
from .rollout import SPARE, CompiledRollout, InterpretedRollout, Rollout
from .step import step
from .steps import Steps
from .track import STAY, Track, crossings

ON_RIDGE = 1e-6
"""Barycentric weight below which a foot is on a side of its face."""
FULL = 1.0 - 1e-9
"""Part of the torque limit that counts as being at it."""


class Simulator:
    """State of the closed loop, and the face whose patch it runs on.

    Starts at rest in the configuration `start` (joint angles, or position and quaternion of the
    body) with the foot near `point` (3,), body frame. `compile_` and `steps`: see machine_code.
    `taxels` (n, 3): read them all at every step.
    """

    def __init__(
        self,
        body: Body,
        loop: ClosedLoopModel,
        start: Array,
        point: Array,
        *,
        compile_: str = "never",
        steps: float = 0.0,
        taxels: Array | None = None,
    ) -> None:
        self.body, self.loop = body, loop
        self.function = step(loop)
        code = machine_code(loop, body.surface.patches, compile_, steps)
        self.stretch: Rollout = (
            InterpretedRollout(loop, self.function, body.surface)
            if code is None
            else CompiledRollout(code)
        )
        self.readings = None if taxels is None else PointReadings(loop, taxels, code=code)
        self.size = len(start)
        self.state = np.zeros(self.function.size1_in(0))
        self._parameters = np.array(loop.parameters.values, dtype=float)
        self.start, self._foot = np.array(start), body.closest(point[None])
        self.touch_error: Callable[[], float] | None = None
        """Stated error of the force at the touch, part of its peak: see stability.touch_error."""
        self.rewind()

    @property
    def curvature(self) -> Array:
        """Principal curvatures (2,) of the body at the first contact, 1/m."""
        return np.asarray(self._foot.curvature[0])

    def at_start(self, q: Array) -> tuple[Array, Array]:
        """State and anchor of the step at rest in configuration `q` at the first contact."""
        state = np.zeros_like(self.state)
        state[: self.size], state[-2:] = q, self._foot.uv[0]
        anchor = flat_anchor(self.body.surface.patches[int(self._foot.face[0])])
        if self.loop.delay:  # at rest, all readings are those of now
            row = np.zeros(REFERENCE)
            output = self.function(state, row, anchor, self.loop.parameters.values)[1].full()
            state[-2 - self.loop.memory : -2] = np.tile(
                output[[self.loop.outputs[k].start for k in ("depth", "force")], 0], self.loop.delay
            )
        return state, anchor

    def rewind(self) -> None:
        """Back to the start, at rest."""
        self.steps, self.seconds = 0, 0.0
        self.saturated = np.zeros(self.loop.joints, dtype=int)
        """Steps (n,) at which each joint's torque was at its limit."""
        self.hops = 0
        """How often the foot left the path's faces."""
        self.state[:] = 0.0
        self.state[: self.size], self.state[-2:] = self.start, self._foot.uv[0]
        self.face = int(self._foot.face[0])
        self._astray = False

    @property
    def steps_per_second(self) -> float:
        """Steps of the closed loop in a second of running it."""
        return self.steps / self.seconds if self.seconds else 0.0

    def advance(
        self,
        track: Track,
        phase: int,
        until_touch: bool = False,
        free: bool = False,
        pace: float = 1.0,
    ) -> Steps:
        """Run the first rows of a track: as many as fit a block and as the foot stays on its faces.

        until_touch: end with the first step in contact. free: follow the path along the normal too,
        instead of holding the force; pace: part of the approach speed that the law may ask for.
        Raises SimulationError where a number is not finite, ReachError where a joint leaves its
        range.
        """
        started = perf_counter()
        short = until_touch or self._astray
        track = track[: self.stretch.lengths[0 if short else 1]]
        placed = self._placed(track)
        self._parameters[APPROACH_SPEED] = pace * self.loop.law.approach_speed
        self._parameters[-1] = free
        try:
            states, outputs = self.stretch.run(self.state, placed, self._parameters, until_touch)
        except RuntimeError as error:
            raise self._diverged(self.state, str(error).strip().splitlines()[-1]) from error
        count, outputs = len(outputs), outputs.copy()
        self._check(states[1:], outputs)
        q = states[:-1, : self.size].copy()
        time = self._times(count)
        self.steps += count
        self.state[:] = states[-1]
        self.face = int(placed.faces[count - 1])
        u, v = self.state[-2:]
        if not min(u, v, 1.0 - u - v) >= (0.0 if self._astray else -SPARE):
            self._hop()
        elif self._astray:
            self._rejoin(int(track.faces[count - 1]))
        readings = None if self.readings is None else self.readings(outputs)
        self.seconds += perf_counter() - started
        return Steps(time, q, outputs, phase, readings)

    def clears(self, poses: Array) -> bool:
        """Whether the body at T_w_b (k, 4, 4) nowhere meets the indenter."""
        return bool(under(self.loop, self.body, poses)[1].max() < 0.0)

    def carry(self, q: Array, phase: int) -> Steps:
        """Move exactly along configurations `q` (k, n), one row a step, as the joints' own
        controllers or a hand do; at rest at the end. A contact that is there may end.

        Raises SimulationError where the body meets the indenter on the way, ReachError where a
        joint leaves its range.
        """
        loop = self.loop
        hit, depth = under(loop, self.body, poses(loop, q))
        outputs = transfer.pressed(loop, hit, depth)
        if loop.joints:
            outputs[:, loop.outputs["torque"]] = transfer.torques(loop, q)
        states = np.zeros((len(q), len(self.state)))
        states[:, : self.size], states[:, -2:] = q, hit.uv
        self._check(states, outputs)
        met = (depth > 0) & ~np.logical_and.accumulate(depth > 0)
        if met.any():
            raise SimulationError(
                f"the body meets the indenter on its way through the air at {self._at(states[-1])}",
                value=f"{depth[met].max() * 1e3:.3g} mm deep",
                remedy="raise exploration.standoff_mm",
            )
        time = self._times(len(q))
        self.steps += len(q)
        self.state[:], self.face, self._astray = states[-1], int(hit.face[-1]), True
        return Steps(time, q, outputs, phase)

    def _placed(self, track: Track) -> Track:
        """The track as it is run: over the machine's face while astray, else from that face on."""
        if self._astray:
            return replace(
                track,
                faces=np.full(len(track), self.face),
                maps=np.tile(STAY, (len(track), 1)),
            )
        maps, first = track.maps.copy(), int(track.faces[0])
        maps[0] = STAY if first == self.face else self._crossing(self.face, first)
        return replace(track, maps=maps)

    def _times(self, count: int) -> Array:
        """Times (count,) of the next steps, s."""
        return np.asarray((self.steps + np.arange(count)) * self.loop.dt, dtype=float)

    def _crossing(self, before: int, after: int) -> Array:
        one = crossings(self.body.surface, np.array([before]), np.array([after]))
        return np.asarray(one[0])

    def _hop(self) -> None:
        """Go on from the foot of the indenter's centre, found on the mesh."""
        centre = centres(self.loop, poses(self.loop, self.state[None, : self.size]))[0]
        hit = self.body.closest(centre[None])
        offset = centre - hit.point[0]
        if hit.normal[0] @ offset < EDGY * np.linalg.norm(offset):
            raise PlaceError(
                f"the contact ran over an edge of the body at {self._at(self.state)}",
                value=f"contact point {np.round(hit.point[0], 4).tolist()} m",
                remedy="keep the exploration off the edge, or round the edge in the mesh",
            )
        self.face, self.state[-2:] = self._over_ridge(hit, offset)
        self._astray = True
        self.hops += 1

    def _over_ridge(self, hit: Closest, offset: Array) -> tuple[int, Array]:
        """The face to go on with and the foot (2,) on it, where the foot `hit` may be on a ridge.

        Of the faces that meet there, the one that looks most along `offset` (3,), the way to the
        indenter's centre: the others' planes reach out over it, and would hold the indenter off.
        """
        face, (u, v) = int(hit.face[0]), hit.uv[0]
        beyond = self.body.surface.neighbours[face][np.array([1.0 - u - v, u, v]) < ON_RIDGE]
        faces = [face, *beyond[beyond >= 0].tolist()]
        best = faces[int(np.argmax(self.body.mesh.face_normals[faces] @ offset))]
        if best == face:
            return face, hit.uv[0]
        change = self._crossing(face, best).reshape(3, 2).T
        return best, change @ [u, v, 1.0]

    def _rejoin(self, face: int) -> None:
        """Run over the path's faces again once the foot lies well on the one under the path."""
        change = self._crossing(self.face, face).reshape(3, 2).T
        u, v = change @ [*self.state[-2:], 1.0]
        self._astray = min(u, v, 1.0 - u - v) < -SPARE / 2

    def _check(self, states: Array, outputs: Array) -> None:
        """Count torques at their limits; raise if a number is not finite or a joint is out."""
        n, arm = self.loop.joints, self.loop.arm
        torque = np.abs(outputs[:, self.loop.outputs["torque"]])
        if n and (torque.max(axis=0) >= FULL * arm.effort_limit).any():
            self.saturated += (torque >= FULL * arm.effort_limit).sum(axis=0)
        q = states[:, :n]
        whole = np.isfinite(states.sum() + outputs.sum())
        if (
            whole
            and (q.min(axis=0) >= arm.lower[:n]).all()
            and (q.max(axis=0) <= arm.upper[:n]).all()
        ):
            return
        finite = np.atleast_1d(np.isfinite(np.hstack([states, outputs])).all(axis=1))
        out = (q < arm.lower[:n]) | (q > arm.upper[:n])
        k = int(np.argmax(~finite | out.any(axis=1)))
        if not finite[k]:
            raise self._diverged(states[k], "a number is not finite", k)
        j = int(np.argmax(out[k]))
        raise ReachError(
            f"joint {arm.joint_names[j]} left its range at {self._at(states[k], k)}",
            value=f"{q[k, j]:.4f} rad",
            limit=f"{arm.lower[j]:.4f} to {arm.upper[j]:.4f} rad",
            remedy="move indenter.position_m or change the mount",
        )

    def _at(self, state: Array, ahead: int = 0) -> str:
        what = "q" if self.loop.joints else "position and quaternion"
        angles = np.round(state[: self.size], 4).tolist()
        return f"t = {(self.steps + ahead) * self.loop.dt:.4f} s, {what} = {angles}"

    def _diverged(self, state: Array, why: str, ahead: int = 0) -> SimulationError:
        return SimulationError(
            f"the closed loop diverged at {self._at(state, ahead)} ({why})",
            value=f"dt = {self.loop.dt} s",
            remedy="take a smaller loop.dt_ms or lower gains",
        )
