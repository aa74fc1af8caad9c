"""The exploration as an explicit state machine over the closed loop.

    approach -> touch -> hold -> slide -> leave -> next -> approach ...

Every place is a track of its own. The body comes down until the first contact (approach), the force
settles (touch), the arm rests (hold), the contact point follows the track (slide), the body lifts
off (leave) and moves to the next place, in the posture that it needs there (next). A contact that
is lost for longer than LOSS_TIME while the law controls the force is made again where it was lost,
at most RETRIES times in a place.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import casadi as ca
import numpy as np

from ..core.arrays import Array
from ..core.errors import EdgeError, LoopError, PlaceError, ReachError
from ..core.se3 import poses_of_states
from ..scene.settings import Exploration
from . import transfer
from .closed_loop_model import REFERENCE, state_of_pose
from .rollout import LENGTHS, GivenUp, Steps
from .simulator import Simulator
from .track import Track, reference_poses

PHASES = ("approach", "touch", "hold", "slide", "leave", "next")
"""Names of the phases, as recordings hold them, in order."""
APPROACH, TOUCH, HOLD, SLIDE, LEAVE, NEXT = range(6)
SETTLED = 0.05
"""Force error, relative to the reference, below which a touch becomes a hold. The settling band of
response.SETTLING_BAND is narrower: the rest of the settling belongs to the hold."""
LOSS_TIME = 0.02
"""Time without contact, s, after which it counts as lost: longer than a bounce at the touch."""
RETRIES = 5
"""Contacts that may be lost in one place before it is given up."""
MAX_LIFTS, CLEARANCE_STRIDE = 10, 16.0
"""Doublings of the standoff that are tried for a transfer; steps between its collision checks."""
SKIP_TIME = 0.2
"""Time along the path that is skipped where it cannot be followed, s."""
HALVINGS, FACING = 5, 0.9
"""Halvings of the standoff that are tried for an approach, and least cosine of the angle between
the path's normal and that of the part of the body nearest to the indenter where it begins. Chosen:
26 degrees, far from those of a wall beside a hollow, down to 1/32 of the standoff."""


class ExplorationStateMachine:
    """Runs a simulator over tracks (places), in order.

    The exploration gives the standoff, the ramp of the approach and the rest after a touch.
    """

    def __init__(
        self,
        simulator: Simulator,
        tracks: Sequence[Track],
        exploration: Exploration,
        postures: Array | None = None,
        forces: Array | None = None,
    ) -> None:
        self.simulator, self.tracks, self.exploration = simulator, tracks, exploration
        self.postures = postures
        """Joint angles (places, n) at the first row of each track, taken before in the air; None:
        no arm."""
        self.forces = forces
        """Reference force (places,), N; None: that of the law."""
        self._middle = simulator.body.surface.bounds.mean(axis=0)
        self.place, self.row = 0, 0
        self._traversed = np.zeros((0, REFERENCE))
        """References (k, 18) by which the contact came from where it was made; none in the air."""
        self.phase = APPROACH
        self.explored = False
        """Whether any contact point has followed its track."""
        self.losses = 0
        """Contacts lost and made again."""

    @property
    def done(self) -> int:
        """Rows of the tracks that are finished."""
        return sum(len(t) for t in self.tracks[: self.place]) + self.row

    def run(self) -> Iterator[Steps]:
        """The steps as they are made.

        Where contact cannot be made or kept, or runs over an edge, a part of the place is given
        up; all of it where the body cannot come to it through the air. Where no place can be
        explored, raises the error of the last one: PlaceError, or ReachError of an arm; also where
        the loop diverges in most of the rows. Where there is one place only, raises it also if most
        of it cannot be explored, or for another reason than an edge, or with an arm.
        """
        simulator = self.simulator
        last: Track | None = None  # the one that the contact has followed, and not left
        for place, track in enumerate(self.tracks):
            self.place, self.row, lost = place, 0, 0
            if place:
                try:
                    yield from self._travel(last, track)
                except (PlaceError, ReachError) as error:
                    last = None if self.phase == NEXT else last
                    simulator.given_up.append(GivenUp(place, slice(0, len(track)), error))
                    continue
            last = track
            if self.forces is not None:
                simulator.force_reference = float(self.forces[place])
            while self.row < len(track):
                try:
                    yield from self._make_contact(track)
                    yield from self._slide(track)
                    if self.row < len(track):
                        lost, self.losses = lost + 1, self.losses + 1
                        if lost > RETRIES:
                            raise self._lost(track)
                except (PlaceError, ReachError) as error:
                    edge = isinstance(error, EdgeError) and not simulator.loop.joints
                    if len(self.tracks) == 1 and not edge:
                        raise
                    reached = track[: self.row + 1]
                    yield from self._skip(track, error)
                    last = reached if simulator.loop.joints else track
        self._check_given_up()

    def _check_given_up(self) -> None:
        """Raise the last error where nothing was explored, or too much given up."""
        given_up = self.simulator.given_up
        alone = len(self.tracks) == 1
        lost = [part for part in given_up if alone or isinstance(part.error, LoopError)]
        rows = sum(part.rows.stop - part.rows.start for part in lost)
        if given_up and (not self.explored or rows > 0.5 * sum(map(len, self.tracks))):
            raise (lost or given_up)[-1].error

    def _skip(self, track: Track, error: PlaceError | ReachError) -> Iterator[Steps]:
        """Give up the next SKIP_TIME of the track; with an arm, the rest of it."""
        rows, first = max(round(SKIP_TIME / self.simulator.loop.dt), 1), self.row
        self.row = len(track) if self.simulator.loop.joints else first + rows
        while self.row < len(track):
            try:
                yield from self._float(self._above(track.references[self.row]))
                break
            except PlaceError:
                self.row += rows
        self.row = min(self.row, len(track))
        self.simulator.given_up.append(GivenUp(self.place, slice(first, self.row), error))

    def _make_contact(self, track: Track) -> Iterator[Steps]:
        """Approach until the first contact, let the force settle, hold."""
        simulator, loop = self.simulator, self.simulator.loop
        settle = max(round(self.exploration.settle / loop.dt), 1)
        rest = track.hold(self.row, max(settle, LENGTHS[0]))
        # the approach at full speed five times over, and the law's lag near the touch
        longest = 5 * self.exploration.standoff / loop.law.approach_speed + 20 / loop.law.gamma
        longest += 1.0 + self.exploration.approach_ramp
        yield from self._descend(track.references[self.row])
        self.phase, force, first = APPROACH, 0.0, simulator.steps
        while not force > 0:
            if simulator.steps > first + int(np.ceil(longest / loop.dt)):
                raise PlaceError(
                    "the arm did not touch the indenter",
                    value=f"{longest:.2f} s of approach",
                    remedy="check indenter.position_m and exploration.standoff_m",
                )
            steps = self._press(rest, first, until_touch=True)
            yield steps
            force = self._force(steps)[-1]
        self.phase, remaining = TOUCH, settle
        while remaining > 0:
            steps = self._press(rest[:remaining], first)
            yield steps
            remaining -= len(steps.time)
            if abs(self._force(steps)[-1] / simulator.force_reference - 1.0) < SETTLED:
                self.phase = HOLD

    def _descend(self, reference: Array) -> Iterator[Steps]:
        """From the standoff over a reference (18,), come straight down to where the place is the
        nearest part of the body: in a hollow the approach would go to a wall beside it.
        """
        simulator, loop = self.simulator, self.simulator.loop
        low, up = reference_poses(reference), loop.indenter_direction
        heights = self.exploration.standoff * 0.5 ** np.arange(HALVINGS + 1)
        poses = np.stack([transfer.raised(low, height * up) for height in heights])
        q = simulator.state[: simulator.size]
        here = loop.body_poses(q[None])[0]
        if np.linalg.norm(here[:3, 3] - poses[0, :3, 3]) > 0.1 * heights[0]:
            return  # near a contact that was lost
        facing = simulator.body.closest(loop.indenter_centres(poses)).normal @ (-low[:3, :3].T @ up)
        k = int(np.argmax(facing > FACING)) if facing.max() > FACING else HALVINGS
        if k:
            self.phase, way = NEXT, transfer.blend(here, poses[k], loop.dt)
            way = loop.follow(way, q) if loop.joints else state_of_pose(way)
            yield simulator.move(way, NEXT)

    def _press(self, rest: Track, first: int, until_touch: bool = False) -> Steps:
        """Steps of an approach that began at step `first`; single ones during its ramp."""
        simulator, dt, ramp = self.simulator, self.simulator.loop.dt, self.exploration.approach_ramp
        fraction = approach_fraction((simulator.steps - first) * dt, ramp, dt)
        return simulator.advance(
            rest if fraction == 1.0 else rest[:1],
            self.phase,
            until_touch=until_touch,
            speed_fraction=fraction,
        )

    def _slide(self, track: Track) -> Iterator[Steps]:
        """Follow the track from the present row, to its end or until contact is lost."""
        first = max(self.row - len(self._traversed), 0)
        self.phase, patience = SLIDE, max(round(LOSS_TIME / self.simulator.loop.dt), 1)
        gap = 0
        while self.row < len(track):
            steps = self.simulator.advance(track[self.row :], SLIDE)
            touching = np.flatnonzero(self._force(steps) > 0)
            ends = np.array([-1 - gap, *touching, len(steps.time)])
            gaps = np.diff(ends) - 1  # steps without contact, with those of the block before
            lost = np.flatnonzero(gaps >= patience)
            if len(lost):  # continue from the last row in contact
                self.row = max(self.row + int(ends[lost[0]]), 0)
                self._traversed = track.references[first : self.row]
                yield steps
                return
            gap = int(gaps[-1])
            self.row += len(steps.time)
            self._traversed = track.references[first : self.row]
            self.explored = True
            yield steps

    def _travel(self, track: Track | None, goal: Track) -> Iterator[Steps]:
        """Lift off the end of a track, if any, and move to above the start of the next.

        Raises PlaceError, or ReachError with an arm, where no path through the air is found.
        """
        if not self.simulator.loop.joints:
            yield from self._float(self._above(goal.references[0]))
            return
        if track is not None:
            yield from self._leave(track)
        assert self.postures is not None
        self.phase = NEXT
        yield self.simulator.move(self._regrasp(goal, self.postures[self.place]), NEXT)

    def _leave(self, track: Track) -> Iterator[Steps]:
        """With an arm: lift off the end of a track."""
        simulator, dt = self.simulator, self.simulator.loop.dt
        low, high = reference_poses(track.references[-1]), self._above(track.references[-1])
        poses = transfer.blend(low, high, dt)
        if not simulator.loop.arm.holds_any_pose:
            # turned about the indenter's axis as the arm must
            poses = simulator.loop.body_poses(
                simulator.loop.follow(poses, simulator.state[: simulator.size])
            )
        motion, self.phase = Track.through(poses, dt, simulator.face), LEAVE
        while len(motion):
            steps = simulator.advance(motion, LEAVE, track_normal=True)
            yield steps
            motion = motion[len(steps.time) :]

    def _float(self, goal: Array) -> Iterator[Steps]:
        """Without an arm: lift off until the body is free to turn, and move to `goal` (4, 4).

        Where the body cannot be lifted off, it goes back to where the contact was made. Raises
        PlaceError where the body meets the indenter on each of these paths.
        """
        simulator = self.simulator
        low = poses_of_states(simulator.state[None])[0]
        try:
            high, over = self._clear_poses(low, goal)
        except PlaceError:
            if len(self._traversed) < 2:
                raise
            back, self.phase = reference_poses(self._traversed[::-1]), LEAVE
            high, over = self._clear_poses(back[-1], goal)
            yield simulator.move(state_of_pose(back), LEAVE)
            low = back[-1]
        for self.phase, start, end in ((LEAVE, low, high), (NEXT, high, over), (NEXT, over, goal)):
            poses = transfer.blend(start, end, simulator.loop.dt, self._middle)
            yield simulator.move(state_of_pose(poses), self.phase)
            self._traversed = self._traversed[:0]

    def _clear_poses(self, low: Array, goal: Array) -> tuple[Array, Array]:
        """Poses (4, 4) above `low` and above `goal` between which the body turns without contact.

        They are the lowest, of one lift; else one of them is as high as it can be. Raises
        PlaceError if there are none.
        """
        simulator, standoff = self.simulator, self.exploration.standoff
        up = simulator.loop.indenter_direction
        dt = CLEARANCE_STRIDE * simulator.loop.dt
        highs: list[Array] = []
        overs: list[Array] = []
        rises = descends = True  # straight
        for lift in standoff * 2.0 ** np.arange(MAX_LIFTS):
            high, over = (
                transfer.raised(low, lift * up),
                transfer.raised(goal, (lift - standoff) * up),
            )
            step = dt if overs or highs else simulator.loop.dt  # as the body is moved
            rises = rises and simulator.is_clear(transfer.blend(low, high, step), leaving=True)
            descends = descends and simulator.is_clear(transfer.blend(over, goal, dt))
            turned = transfer.blend(high, over, dt, self._middle)
            if rises and descends and simulator.is_clear(turned):
                return high, over
            highs += [high] if rises else []
            overs += [over] if descends else []
        pairs = [(h, o) for h in highs[-1:] for o in overs]
        pairs += [(h, o) for h in highs for o in overs[-1:]]
        for high, over in pairs:
            if simulator.is_clear(transfer.blend(high, over, dt, self._middle)):
                return high, over
        raise PlaceError(
            "the body meets the indenter on every path through the air",
            value=f"lifts up to {standoff * 2.0 ** (MAX_LIFTS - 1):.3g} m to place {self.place}",
            remedy="keep the exploration off the inside of the body, or raise "
            "exploration.standoff_mm",
        )

    def _regrasp(self, goal: Track, posture: Array) -> Array:
        """Joint angles (k, n) from the present ones to a posture above the start of a track."""
        simulator, loop = self.simulator, self.simulator.loop
        low, high = reference_poses(goal.references[0]), self._above(goal.references[0])
        poses = np.concatenate([transfer.blend(low, high, loop.dt)[:: LENGTHS[0]], high[None]])
        above = loop.follow(poses, posture)[-1]
        start = simulator.state[: simulator.size].copy()
        return transfer.joint_path(loop, simulator.body, start, above)

    def _above(self, reference: Array) -> Array:
        """T_w_b (4, 4) at the standoff over a reference (18,)."""
        up = self.simulator.loop.indenter_direction
        return transfer.raised(reference_poses(reference), self.exploration.standoff * up)

    def _force(self, steps: Steps) -> Array:
        return np.asarray(steps.outputs[:, self.simulator.loop.outputs["force"].start])

    def _lost(self, track: Track) -> PlaceError:
        dt, pieces = self.simulator.loop.dt, self.simulator.body.surface.pieces
        rows = round(LOSS_TIME / dt)
        near = pieces[track.faces[max(self.row - rows, 0) : self.row + rows + 1]]
        remedy = "explore slower, or set a larger law.gamma or law.rate"
        if np.any(near != near[0]):
            remedy = "begin a segment (Path.breaks) where the path goes to another part of the body"
        return PlaceError(
            f"contact was lost {RETRIES + 1} times",
            value=f"row {self.row} of place {self.place} at t = {self.simulator.steps * dt:.4f} s",
            remedy=remedy,
        )


def approach_fraction(t: Any, ramp: Any, dt: Any) -> Any:
    """Part of the approach speed at t (s) after the approach began: a linear ramp; CasADi."""
    return ca.fmin((t + dt) / ca.fmax(ramp, dt), 1.0)
