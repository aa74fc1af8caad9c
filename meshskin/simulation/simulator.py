"""The simulator: the state of the closed loop, the mesh face it runs on, and its checks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from time import perf_counter

import numpy as np

from ..core.arrays import Array
from ..core.errors import EdgeError, LoopError, PlaceError, ReachError
from ..core.se3 import poses_of_states
from ..geometry.body import Body
from ..geometry.surface.closest_point import Closest
from ..geometry.surface.surface import EDGE_COSINE
from . import transfer
from .closed_loop_model import (
    APPROACH_SPEED,
    FORCE_REFERENCE,
    REFERENCE,
    ClosedLoopModel,
    flat_anchor,
)
from .integrators import step
from .machine_code import machine_code
from .rollout import GivenUp, InterpretedRollout, Rollout, Steps
from .track import FACE_MARGIN, IDENTITY_MAP, Track, face_maps, face_margin, map_foot

EDGE_WEIGHT = 1e-6
"""Barycentric weight below which a foot point counts as on a side of its face."""
AT_LIMIT = 1.0 - 1e-9
"""Part of the torque limit from which a torque counts as at the limit."""
UNIT = 1e-4
"""Error of a unit normal from which a patch counts as folded at the foot point. Rounding reaches
1e-10 on a face of 86 mm by 0.2 mm; on a sphere of 10 mm this error is 1 um of depth."""
FORCE_ERROR = 0.05
"""Error of the force, relative to the reference, from which a foot point beside its face is sought
on the mesh: there a patch of a long thin triangle, or at a crease, may leave the surface."""
MAX_FLIGHT = 4.0
"""Way in one block of steps, in extents of the body, beyond which a body without an arm has flown
off: a block lasts for half a second at steps of 1 ms, in which an approach makes 5 cm."""


class Simulator:
    """State of the closed loop, and the face whose patch it runs on.

    Starts at rest in the configuration `start` (joint angles, or position and quaternion of the
    body) with the foot point near `point` (3,), body frame, m. `compile_` and `steps`: see
    machine_code.
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
    ) -> None:
        self.body, self.loop = body, loop
        self.function = step(loop)
        code = machine_code(loop, body.surface.patches, compile_, steps)
        self.rollout: Rollout = code or InterpretedRollout(loop, body.surface)
        self.size = len(start)
        """Length n of a configuration."""
        self.state = np.zeros(self.function.size1_in(0))
        self._parameters = np.array(loop.parameters.values, dtype=float)
        self.start, self._first_contact = np.array(start), body.closest(point[None])
        self.touch_error: Callable[[], float] | None = None
        """Estimated error of the force at the touch, relative to its peak; see stability."""
        self.reset()

    @property
    def curvature(self) -> Array:
        """Principal curvatures (2,) of the body at the first contact, 1/m."""
        return np.asarray(self._first_contact.curvature[0])

    def rest_state(self, q: Array) -> tuple[Array, Array]:
        """State and anchor of the step at rest in configuration `q` (n,) at the first contact."""
        state = np.zeros_like(self.state)
        state[: self.size], state[-2:] = q, self._first_contact.uv[0]
        anchor = flat_anchor(self.body.surface.patches[int(self._first_contact.face[0])])
        if self.loop.delay:  # at rest, all delayed measurements are the present one
            rows = [self.loop.outputs[k].start for k in ("depth", "force")]
            state[-2 - self.loop.memory : -2] = np.tile(
                self.output(state, anchor)[rows], self.loop.delay
            )
        return state, anchor

    def output(self, state: Array, anchor: Array) -> Array:
        """The output (m,) of the step at a state; see ClosedLoopModel.outputs."""
        inputs = state, np.zeros(REFERENCE), anchor, self.loop.parameters.values
        return np.asarray(self.function(*inputs)[1].full()[:, 0])

    def reset(self) -> None:
        """Return to the start, at rest."""
        self.steps, self.seconds = 0, 0.0
        self.force_reference = self.loop.law.force_reference
        """Reference contact force of the next steps, N."""
        self.saturated = np.zeros(self.loop.joints, dtype=int)
        """Steps (n,) at which each joint's torque was at its limit."""
        self.relocations = 0
        """How often the foot point left the path's faces and was searched for on the mesh."""
        self.given_up: list[GivenUp] = []
        """Parts of the path that were given up."""
        self.state[:] = 0.0
        self.state[: self.size], self.state[-2:] = self.start, self._first_contact.uv[0]
        self.face = int(self._first_contact.face[0])
        self._off_path = False

    @property
    def steps_per_second(self) -> float:
        """Steps of the closed loop per second of computing time."""
        return self.steps / self.seconds if self.seconds else 0.0

    def advance(
        self,
        track: Track,
        phase: int,
        until_touch: bool = False,
        track_normal: bool = False,
        speed_fraction: float = 1.0,
    ) -> Steps:
        """Run the first rows of a track: as many as fit a block, while the foot stays on its faces.

        until_touch: end with the first step in contact. track_normal: follow the path along the
        normal, too, instead of controlling the force. speed_fraction: part of the approach speed
        that the law may ask for. Ends where the patch under the contact folds or leaves the
        surface. Raises PlaceError where a number is not finite, a body without an arm flies off, or
        the patch folds at once, ReachError where a joint leaves its range; the state is then that
        before. Raises EdgeError where the contact runs over an edge.
        """
        started = perf_counter()
        short = until_touch or self._off_path
        track = track[: self.rollout.lengths[0 if short else 1]]
        placed = self._placed(track)
        self._parameters[FORCE_REFERENCE] = self.force_reference
        self._parameters[APPROACH_SPEED] = speed_fraction * self.loop.law.approach_speed
        self._parameters[-1] = track_normal
        try:
            states, outputs = self.rollout.run(self.state, placed, self._parameters, until_touch)
        except RuntimeError as error:
            raise self._diverged(self.state, str(error).strip().splitlines()[-1]) from error
        ran, count = len(outputs), self._unfolded(outputs)
        on = self._on_surface(states[: count + 1], outputs[:count], placed)
        if not on and not self._off_path:
            self._relocate()
            return self.advance(track, phase, until_touch, track_normal, speed_fraction)
        if not on:
            states, outputs = self._followed(placed[:1])
        count = max(on, 1)
        left, outputs, states = count < ran, outputs[:count].copy(), states[: count + 1]
        self._check(states[1:], outputs)
        if not self.loop.joints:
            self._check_flight(states[-1])
        q, time = states[:-1, : self.size].copy(), self._times(count)
        self.steps += count
        self.state[:] = states[-1]
        self.face = int(placed.faces[count - 1])
        margin = 0.0 if self._off_path else -FACE_MARGIN
        if left or not face_margin(self.state[-2:]) >= margin:
            self._relocate()
        elif self._off_path:
            self._rejoin(int(track.faces[count - 1]))
        self.seconds += perf_counter() - started
        return Steps(time, q, outputs, phase, self.force_reference)

    def _followed(self, track: Track) -> tuple[Array, Array]:
        """States (2, n) and output (1, m) of a step that follows a track (1,) along the normal,
        too. The contact is that of the mesh: on a ridge a step of the foot point within the patch
        of either side may lead off the surface, to any depth.
        """
        loop, self._parameters[-1] = self.loop, True
        states, outputs = self.rollout.run(self.state, track, self._parameters, False)
        poses = loop.body_poses(self.state[None, : self.size])
        contact = transfer.contact_outputs(loop, *transfer.penetration(loop, self.body, poses))
        contact[:, loop.outputs["torque"]] = outputs[:, loop.outputs["torque"]]
        return states, contact

    def is_clear(self, poses: Array, leaving: bool = False) -> bool:
        """Whether the body at T_w_b (k, 4, 4) nowhere meets the indenter.

        leaving: apart from the contact that it may start in.
        """
        meets = transfer.penetration(self.loop, self.body, poses)[1] >= 0.0
        return not (meets & ~np.logical_and.accumulate(meets) if leaving else meets).any()

    def move(self, q: Array, phase: int) -> Steps:
        """Move exactly along configurations `q` (k, n), one row a step, and end at rest.

        This is the motion under the joints' own controllers. It may start in contact. Raises
        PlaceError where the body meets the indenter on the way, ReachError where a joint leaves
        its range.
        """
        loop = self.loop
        hit, depth = transfer.penetration(loop, self.body, loop.body_poses(q))
        outputs = transfer.contact_outputs(loop, hit, depth)
        if loop.joints:
            outputs[:, loop.outputs["torque"]] = transfer.transfer_torques(loop, q)
        states = np.zeros((len(q), len(self.state)))
        states[:, : self.size], states[:, -2:] = q, hit.uv
        self._check(states, outputs)
        collides = (depth > 0) & ~np.logical_and.accumulate(depth > 0)
        if collides.any():
            raise PlaceError(
                "the body meets the indenter in the air",
                value=f"{depth[collides].max() * 1e3:.3g} mm deep at {self._at(states[-1])}",
                remedy="raise exploration.standoff_mm",
            )
        time = self._times(len(q))
        self.steps += len(q)
        self.state[:], self.face, self._off_path = states[-1], int(hit.face[-1]), True
        return Steps(time, q, outputs, phase, self.force_reference)

    def _placed(self, track: Track) -> Track:
        """The track as it is run: over the simulator's face while off the path, else from there."""
        if self._off_path:
            return track.on_face(self.face)
        maps, first = track.maps.copy(), int(track.faces[0])
        maps[0] = IDENTITY_MAP if first == self.face else self._face_map(self.face, first)
        return replace(track, maps=maps)

    def _times(self, count: int) -> Array:
        """Times (count,) of the next steps, s."""
        return np.asarray((self.steps + np.arange(count)) * self.loop.dt, dtype=float)

    def _face_map(self, before: int, after: int) -> Array:
        maps = face_maps(self.body.surface, np.array([before]), np.array([after]))
        return np.asarray(maps[0])

    def _relocate(self) -> None:
        """Continue from the foot point of the indenter's centre, searched for on the mesh."""
        loop = self.loop
        centre = loop.indenter_centres(loop.body_poses(self.state[None, : self.size]))[0]
        hit = self.body.closest(centre[None])
        offset = centre - hit.point[0]
        if hit.normal[0] @ offset < EDGE_COSINE * np.linalg.norm(offset):
            raise EdgeError(
                "the contact ran over an edge of the body",
                value=f"contact point {np.round(hit.point[0], 4).tolist()} m at "
                f"{self._at(self.state)}",
                remedy="keep the exploration off the edge, or round the edge in the mesh",
            )
        self.face, self.state[-2:] = self._facing(hit, offset)
        self._off_path = True
        self.relocations += 1

    def _facing(self, hit: Closest, offset: Array) -> tuple[int, Array]:
        """Face and foot point (2,) to continue with where the foot point may lie on a ridge: that
        whose normal is closest to `offset` (3,), from the foot point to the indenter's centre.
        Patches of others that meet there extend over it, and would hold the indenter off."""
        face, uv = int(hit.face[0]), hit.uv[0]
        sides = np.array([1.0 - uv.sum(), *uv]) < EDGE_WEIGHT
        beyond = self.body.surface.neighbours[face][sides]
        faces = [face, *beyond[beyond >= 0].tolist()]
        foots = [uv, *(map_foot(self._face_map(face, k), uv) for k in faces[1:])]
        normals = self.body.surface.at(np.array(faces), np.array(foots)).normal
        best = int(np.argmax(normals @ offset))
        return faces[best], foots[best]

    def _rejoin(self, face: int) -> None:
        """Use the path's faces again once the foot point lies well on the one under the path."""
        uv = map_foot(self._face_map(self.face, face), self.state[-2:])
        self._off_path = bool(face_margin(uv) < -FACE_MARGIN / 2)

    def _unfolded(self, outputs: Array) -> int:
        """Number of the first rows of outputs (k, m) with a contact: beyond its face a patch may
        fold, and has no normal there. Raises PlaceError where there are none.
        """
        normals = outputs[:, self.loop.outputs["normal"]]
        folded = np.abs(np.einsum("ki,ki->k", normals, normals) - 1.0) > 2.0 * UNIT
        count = int(np.argmax(folded)) if folded.any() else len(outputs)
        if count == 0:
            raise PlaceError(
                "the surface under the contact folds",
                value=f"a face of {1e6 * self.body.mesh.area_faces[self.face]:.3g} mm2 at "
                f"{self._at(self.state)}",
                remedy="repair the long thin triangles there (Body.skinned), or leave that part of "
                "the body out of the skin's region",
            )
        return count

    def _on_surface(self, states: Array, outputs: Array, track: Track) -> int:
        """Number of the first rows of outputs (k, m) whose contact is that of the surface, also
        where the foot point in `states` (k + 1, n) is beside its face on the track."""
        loop, column = self.loop, self.loop.outputs["force"].start
        beside = face_margin(states[1:, -2:]) < -EDGE_WEIGHT
        rows = np.flatnonzero(beside & (outputs[:, column] > 0.0))
        if not len(rows):
            return len(outputs)
        centres = loop.indenter_centres(loop.body_poses(states[rows, : self.size]))
        hit = self.body.surface.nearest(centres, track.faces[rows])
        force = transfer.contact_outputs(loop, hit, loop.indenter_radius - hit.distance)[:, column]
        off = np.abs(outputs[rows, column] - force) > FORCE_ERROR * self.force_reference
        off &= force > 0.0  # without contact it is lost, as on the way to another part of the body
        return int(rows[np.argmax(off)]) if off.any() else len(outputs)

    def _check(self, states: Array, outputs: Array) -> None:
        """Count torques at their limits; raise if a number is not finite or a joint is out."""
        n, arm = self.loop.joints, self.loop.arm
        torque = np.abs(outputs[:, self.loop.outputs["torque"]])
        if n and (torque.max(axis=0) >= AT_LIMIT * arm.effort_limit).any():
            self.saturated += (torque >= AT_LIMIT * arm.effort_limit).sum(axis=0)
        q, lower, upper = states[:, :n], arm.lower[:n], arm.upper[:n]
        finite = np.isfinite(states.sum() + outputs.sum())
        if finite and (q.min(axis=0) >= lower).all() and (q.max(axis=0) <= upper).all():
            return
        valid = np.asarray(np.isfinite(np.hstack([states, outputs])).all(axis=1))
        outside = (q < lower) | (q > upper)
        k = int(np.argmax(~valid | outside.any(axis=1)))
        if not valid[k]:
            raise self._diverged(states[k], "a number is not finite", k)
        j = int(np.argmax(outside[k]))
        raise ReachError(
            f"joint {arm.joint_names[j]} left its range",
            value=f"{q[k, j]:.4f} rad at {self._at(states[k], k)}",
            limit=f"{arm.lower[j]:.4f} to {arm.upper[j]:.4f} rad",
            remedy="move indenter.position_m or change the mount",
        )

    def _check_flight(self, state: Array) -> None:
        """Raise PlaceError where a body without an arm is far from where it was."""
        middle, limit = self.body.surface.bounds.mean(axis=0), MAX_FLIGHT * self.body.surface.scale
        if np.linalg.norm(state[:3] - self.state[:3]) + 2 * np.linalg.norm(middle) <= limit:
            return  # near, however it turned
        before, now = poses_of_states(np.stack([self.state, state])) @ np.append(middle, 1.0)
        if (way := float(np.linalg.norm(now - before))) > limit:
            raise PlaceError(
                "the body flew off its path",
                value=f"{way:.3g} m at once at {self._at(self.state)}",
                limit=f"{limit:.3g} m",
                remedy="keep the exploration to smooth parts of the body, or lower law.gamma",
            )

    def _at(self, state: Array, ahead: int = 0) -> str:
        """Time and configuration of a state, `ahead` steps from now, for messages."""
        what = "q" if self.loop.joints else "position and quaternion"
        angles = np.round(state[: self.size], 4).tolist()
        return f"t = {(self.steps + ahead) * self.loop.dt:.4f} s, {what} = {angles}"

    def _diverged(self, state: Array, reason: str, ahead: int = 0) -> LoopError:
        return LoopError(
            f"the closed loop diverged ({reason})",
            value=f"dt = {self.loop.dt} s at {self._at(state, ahead)}",
            remedy="set a smaller loop.dt_ms or lower gains",
        )
