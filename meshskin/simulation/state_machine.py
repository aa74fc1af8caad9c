"""The exploration as an explicit state machine over the closed loop.

    approach -> touch -> hold -> slide -> leave -> next -> approach ...

Every place is a track of its own. The body comes down until the first contact (approach), the force
settles (touch), the arm rests (hold), the contact point follows the track (slide), the body lifts
off (leave) and moves to the next place, taking the posture that it wants (next). Contact that is
lost for longer than PATIENCE while the law should hold it is sought again where it was lost, at
most RETRIES times in a place.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ..core.errors import PlaceError, SimulationError
from ..core.se3 import Array, interpolate, inverse, log_so3
from ..core.se3 import poses_of_states as body_pose
from . import transfer
from .quasi_static import start as body_state
from .rollout import LENGTHS
from .simulator import Simulator
from .steps import Steps
from .track import Track, reference_poses

PHASES = ("approach", "touch", "hold", "slide", "leave", "next")
"""Names of the phases, as recordings hold them, in order."""
APPROACH, TOUCH, HOLD, SLIDE, LEAVE, NEXT = range(6)
SETTLED = 0.05
"""Part of the reference force within which a touch counts as settled."""
PATIENCE = 0.02
"""Time without contact after which it counts as lost, s."""
RETRIES = 5
"""Contacts that may be lost in one place before it is given up."""
HIGHEST, SIGHT = 10, 16.0
"""Doublings of the standoff that a way over may take; steps between looks ahead on it."""
SKIP = 0.2
"""Time along the path that is given up where it cannot be followed, s."""
ASTRAY = 4.0
"""Distance from the next place, in extents of the body, that no exploration has."""
AIR_SPEED, AIR_TURN = 0.1, 1.0
"""Speeds in the air, m/s and rad/s."""


@dataclass(frozen=True)
class PhaseSettings:
    """How places are explored."""

    standoff: float
    """Height over the indenter between places, m."""
    settle: float
    """Longest time for the touch to settle, and with it the rest before the slide, s."""
    ramp: float = 0.0
    """Time in which the approach gains its speed, s."""


class ExplorationStateMachine:
    """Runs a machine over tracks (places), in order, and says what it is doing."""

    def __init__(
        self,
        machine: Simulator,
        tracks: Sequence[Track],
        manner: PhaseSettings,
        postures: Array | None = None,
    ) -> None:
        self.machine, self.tracks, self.manner = machine, tracks, manner
        self.postures = postures
        """Joint angles (places, n) at the first row of each track, taken in the air before; None:
        the body is carried over, in whatever posture the arm is."""
        self.place, self.row = 0, 0
        self.phase = APPROACH
        self.cut = 0
        """Parts of places given up."""
        self.explored = False
        """Whether anything has been."""
        self.losses = 0
        """Contacts lost and found again."""

    @property
    def done(self) -> int:
        """Rows of the tracks that are behind."""
        return sum(len(t) for t in self.tracks[: self.place]) + self.row

    def run(self) -> Iterator[Steps]:
        """The steps as they come.

        Where contact cannot be made or kept, or runs over an edge, a part of the place is given
        up. Raises PlaceError where it is the only place, or nothing at all is explored.
        """
        failed: PlaceError | None = None
        for place, track in enumerate(self.tracks):
            self.place, self.row, lost = place, 0, 0
            while self.row < len(track):
                try:
                    yield from self._make_contact(track)
                    yield from self._slide(track)
                    if self.row < len(track):
                        lost, self.losses = lost + 1, self.losses + 1
                        if lost > RETRIES:
                            raise self._lost()
                except PlaceError as error:
                    if len(self.tracks) == 1:
                        raise
                    failed = error
                    yield from self._skip(track)
            if self.place + 1 < len(self.tracks):
                yield from self._travel(track, self.tracks[self.place + 1])
        if failed is not None and not self.explored:
            raise failed

    def _skip(self, track: Track) -> Iterator[Steps]:
        """Give up the next of the track, and go on beyond; with an arm, give up the rest."""
        self.cut += 1
        rows = max(round(SKIP / self.machine.loop.dt), 1)
        self.row = len(track) if self.machine.loop.joints else self.row + rows
        if self.row < len(track):
            yield from self._drift(self._above(track.references[self.row]))

    def _make_contact(self, track: Track) -> Iterator[Steps]:
        """Come down, let the force settle, rest."""
        machine, loop = self.machine, self.machine.loop
        settle = max(round(self.manner.settle / loop.dt), 1)
        rest = track.hold(self.row, max(settle, LENGTHS[0]))
        fall = 5 * self.manner.standoff / loop.law.approach_speed + 20 / loop.law.gamma
        fall += self.manner.ramp
        last = machine.steps + int(np.ceil((1.0 + fall) / loop.dt))
        self.phase, force, begin = APPROACH, 0.0, machine.steps
        while not force > 0:
            if machine.steps > last:
                raise PlaceError(
                    "the arm did not touch the indenter",
                    value=f"{(1.0 + fall):.2f} s of approach",
                    remedy="check indenter.position_m and exploration.standoff_m",
                )
            steps = self._press(rest, begin, until_touch=True)
            yield steps
            force = self._force(steps)[-1]
        self.phase, left = TOUCH, settle
        while left > 0:
            steps = self._press(rest[:left], begin)
            yield steps
            left -= len(steps.time)
            if abs(self._force(steps)[-1] / loop.law.force_reference - 1.0) < SETTLED:
                self.phase = HOLD

    def _press(self, rest: Track, begin: int, until_touch: bool = False) -> Steps:
        """Steps of an approach begun at step `begin`: single ones while it gains its speed."""
        machine = self.machine
        pace = paced((machine.steps - begin) * machine.loop.dt, self.manner.ramp, machine.loop.dt)
        return machine.advance(
            rest if pace == 1.0 else rest[:1], self.phase, until_touch=until_touch, pace=pace
        )

    def _slide(self, track: Track) -> Iterator[Steps]:
        """Follow the track from the row at hand, to its end or until contact is lost."""
        self.phase, patience = SLIDE, max(round(PATIENCE / self.machine.loop.dt), 1)
        apart = 0
        while self.row < len(track):
            steps = self.machine.advance(track[self.row :], SLIDE)
            touching = np.flatnonzero(self._force(steps) > 0)
            ends = np.array([-1 - apart, *touching, len(steps.time)])
            gaps = np.diff(ends) - 1  # steps without contact, the last block's counted in
            lost = np.flatnonzero(gaps >= patience)
            if len(lost):  # go on from where contact was last
                self.row = max(self.row + int(ends[lost[0]]), 0)
                yield steps
                return
            apart = int(gaps[-1])
            self.row += len(steps.time)
            self.explored = True
            yield steps

    def _travel(self, track: Track, goal: Track) -> Iterator[Steps]:
        """Lift off the end of a track and move to above the start of the next."""
        machine, dt = self.machine, self.machine.loop.dt
        if not machine.loop.joints:
            yield from self._drift(self._above(goal.references[0]))
            return
        ways = [reference_poses(track.references[-1]), self._above(track.references[-1])]
        if self.postures is None:
            ways += [self._above(goal.references[0])]
        for self.phase, start, end in zip((LEAVE, NEXT), ways[:-1], ways[1:], strict=False):
            face = machine.face
            way = Track.through(_blend(start, end, dt), dt, face)
            while len(way):
                steps = machine.advance(way, self.phase, free=True)
                yield steps
                way = way[len(steps.time) :]
        if self.postures is not None:
            self.phase = NEXT
            yield machine.carry(self._over(goal, self.postures[self.place + 1]), NEXT)

    def _drift(self, goal: Array) -> Iterator[Steps]:
        """Without an arm: up, as far as it takes to turn, and over to `goal` (4, 4), in the air."""
        machine, standoff, up = self.machine, self.manner.standoff, self._up
        low = body_pose(machine.state[None])[0]
        middle = np.append(machine.body.mesh.bounds.mean(axis=0), 1.0)
        if np.linalg.norm((low - goal) @ middle) > ASTRAY * machine.body.surface.scale:
            raise SimulationError(
                f"the body flew off place {self.place}",
                value=f"position {np.round(low[:3, 3], 3).tolist()} m",
                remedy="keep the exploration to smooth parts of the body",
            )
        for lift in standoff * 2.0 ** np.arange(HIGHEST):
            high, over = _raised(low, lift * up), _raised(goal, (lift - standoff) * up)
            if machine.clears(_blend(high, over, SIGHT * machine.loop.dt)):
                break
        ways = ((LEAVE, low, high), (NEXT, high, over), (NEXT, over, goal))
        for self.phase, start, end in ways:
            poses = _blend(start, end, machine.loop.dt)
            yield machine.carry(np.array([body_state(pose) for pose in poses]), self.phase)

    def _over(self, goal: Track, posture: Array) -> Array:
        """Joint angles (k, n) from where the arm is to above the start of a track."""
        machine, loop = self.machine, self.machine.loop
        low = reference_poses(goal.references[0])
        high = self._above(goal.references[0])
        poses = _blend(low, high, loop.dt)[:: LENGTHS[0]] @ inverse(loop.mount)
        above = loop.arm.inverse_kinematics(
            np.concatenate([poses, high[None] @ inverse(loop.mount)]), posture
        )[-1]
        return transfer.way(loop, machine.body, machine.state[: machine.size].copy(), above)

    @property
    def _up(self) -> Array:
        """Unit vector (3,), world, in which the body is lifted off."""
        return self.machine.loop.indenter_direction

    def _above(self, reference: Array) -> Array:
        """T_w_b (4, 4) at the standoff over a reference row."""
        return _raised(reference_poses(reference), self.manner.standoff * self._up)

    def _force(self, steps: Steps) -> Array:
        return np.asarray(steps.outputs[:, self.machine.loop.outputs["force"].start])

    def _lost(self) -> PlaceError:
        return PlaceError(
            f"contact was lost {RETRIES + 1} times at row {self.row} of place {self.place}",
            value=f"t = {self.machine.steps * self.machine.loop.dt:.4f} s",
            remedy="explore slower, or take a larger law.gamma or law.rate",
        )


def paced(t: Any, ramp: Any, dt: Any) -> Any:
    """Part of the approach speed at t (s) after the approach's begin, grown evenly; CasADi."""
    return ca.fmin((t + dt) / ca.fmax(ramp, dt), 1.0)


def _raised(pose: Array, shift: Array) -> Array:
    """A pose (4, 4) shifted by (3,), world, m."""
    raised = pose.copy()
    raised[:3, 3] += shift
    return raised


def _blend(start: Array, end: Array, dt: float) -> Array:
    """Poses (k, 4, 4) from one to another, half a cosine in time."""
    turn = log_so3(end[:3, :3] @ start[:3, :3].T)
    shift = end[:3, 3] - start[:3, 3]
    time = (
        0.5
        * np.pi
        * max(float(np.linalg.norm(shift)) / AIR_SPEED, float(np.linalg.norm(turn)) / AIR_TURN)
    )
    part = 0.5 - 0.5 * np.cos(np.pi * np.linspace(0.0, 1.0, max(int(np.ceil(time / dt)), 2)))
    return interpolate(start, end, part)
