"""Shooting a manoeuvre through the closed loop's own step, as expressions of the gains.

The state is the step's, with the time since the first touch and the last depth beside it: the slide
begins when the rest after the touch is over, wherever that falls, so that the whole is a function
of the gains without events. Between two steps the time of the touch is interpolated from the
depths. Torques are not held within their limits here: that they are is for the problem to see to,
and then the simulator's are the same.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from ..core.codegen import compile_with_derivatives
from ..core.se3 import Array
from ..scene.scene import Scene
from ..simulation import quasi_static
from ..simulation.closed_loop_model import ClosedLoopModel
from ..simulation.state_machine import approach_fraction
from ..simulation.step import step
from .gains import NAMES, Gains, Scenario
from .manoeuvre import Manoeuvre, travelled

TINY = 1e-12
"""Depth, m, that keeps the part of a step in contact from being 0 / 0."""


@dataclass(frozen=True)
class Trajectory:
    """A manoeuvre as it is predicted, a row a step."""

    scenario: Scenario
    time: Array
    """(k,), s, from the start at the standoff."""
    force: Array
    """(k,), N."""
    depth: Array
    """(k,), m; negative in the air."""
    since: Array
    """Time since the first touch (k,), s; 0 before it."""
    torque: Array
    """(k, n), N m; without columns where there is no arm."""
    q: Array
    """Joint angles (k, n), rad."""
    qdot: Array
    """Joint speeds (k, n), rad/s."""
    duration: float
    """From the start to the end of the slide, s."""


class ShootingInterval:
    """One scenario of the problem: its world, its manoeuvre, the step that is shot through."""

    def __init__(self, scene: Scene, scenario: Scenario, manoeuvre: Manoeuvre) -> None:
        self.scene, self.scenario, self.manoeuvre = scene, scenario, manoeuvre
        loop = ClosedLoopModel.of(scene)
        free = replace(loop.arm, effort_limit=np.full_like(loop.arm.effort_limit, np.inf))
        self.arm, self.loop = loop.arm, replace(loop, arm=free)
        self.joints = loop.joints
        self.one = _one(self.loop, manoeuvre)

    @property
    def start(self) -> Array:
        """State at rest at the standoff."""
        begin = self.manoeuvre.start
        q = quasi_static.state_of_pose(begin) if self.loop.mode == "quasi_static" else begin
        state = np.zeros(self.one.size1_in(0))
        state[: len(q)] = q
        state[-4:] = [*self.manoeuvre.foot, 0.0, -self.scene.exploration.standoff]
        return state

    def roll(self, gains: ca.MX, steps: int) -> ca.MX:
        """Rows `rows` of every step (m, steps), of gains (8,)."""
        one, compile_ = self.one, self.scene.loop.compile
        one = one if compile_ == "never" else compile_with_derivatives(one, len(NAMES))
        several = one.mapaccum("shot", steps)
        rolled: ca.MX = several(self.start, ca.repmat(gains, 1, steps), self.times(steps))[1]
        return rolled

    def times(self, steps: int) -> Array:
        """Time at each step (1, steps), s."""
        return np.arange(steps, dtype=np.float64)[None] * self.loop.dt

    def rows(self) -> dict[str, slice]:
        """What the rows of `roll` are."""
        n = self.joints
        ends = np.cumsum([0, 1, 1, 1, n, n, n])
        names = ("force", "depth", "since", "torque", "q", "qdot")
        return {k: slice(a, b) for k, a, b in zip(names, ends[:-1], ends[1:], strict=True)}

    def predict(self, gains: Gains) -> Trajectory:
        """The manoeuvre with these gains, to the end of its slide."""
        slide = self.manoeuvre.distance / gains.speed + gains.ramp
        dt, standoff = self.loop.dt, self.scene.exploration.standoff
        fall = 2.0 * standoff / gains.approach_speed + 20.0 / gains.gamma + gains.approach_ramp
        steps = int(np.ceil((fall + gains.settle + slide) / dt)) + 2
        several = self.one.mapaccum("shot", steps)
        values = np.tile(np.array(gains.values), (steps, 1)).T
        rolled = several(self.start, values, self.times(steps))[1].full()
        rows = {k: rolled[s] for k, s in self.rows().items()}
        since = rows["since"][0]
        before = int(np.argmax(since > 0)) if since.any() else steps
        duration = before * dt - (since[before] if before < steps else 0.0) + gains.settle + slide
        count = min(int(np.ceil(duration / dt)) + 1, steps)
        return Trajectory(
            self.scenario,
            np.arange(count, dtype=np.float64) * dt,
            rows["force"][0, :count],
            rows["depth"][0, :count],
            since[:count],
            rows["torque"][:, :count].T,
            rows["q"][:, :count].T,
            rows["qdot"][:, :count].T,
            float(duration),
        )


def _one(loop: ClosedLoopModel, manoeuvre: Manoeuvre) -> ca.Function:
    """(state with clock and last depth, gains (8,), time) -> (the same after the step, its row)."""
    inner = step(loop)
    size = inner.size1_in(0)
    state, vector = ca.SX.sym("state", size + 2), ca.SX.sym("gains", len(NAMES))
    time = ca.SX.sym("time")
    clock, last = state[size], state[size + 1]
    gains = Gains(*(vector[k] for k in range(len(NAMES))))
    reference = _reference(manoeuvre, clock - gains.settle, gains, loop.dt)
    parameters = replace(
        loop.parameters,
        gamma=gains.gamma,
        rate=gains.rate,
        force_reference=gains.force_reference,
        approach_speed=gains.approach_speed * approach_fraction(time, gains.approach_ramp, loop.dt),
    )
    after, output = inner(
        state[:size], reference, ca.DM(manoeuvre.anchor), ca.vertcat(*parameters.values)
    )
    rows, n = loop.outputs, loop.joints
    depth = output[rows["depth"]]
    touching = (ca.fmax(last, 0.0) + ca.fmax(depth, 0.0)) / (ca.fabs(last) + ca.fabs(depth) + TINY)
    since = clock + loop.dt * touching
    row = ca.vertcat(
        output[rows["force"]], depth, since, output[rows["torque"]], state[:n], state[n : 2 * n]
    )
    return ca.Function(
        "one", [state, vector, time], [ca.vertcat(after, since, depth), row], {"cse": True}
    )


def _reference(manoeuvre: Manoeuvre, t: Any, gains: Gains, dt: float) -> Any:
    """The path's row (18,) `t` s after the slide's begin: the twist carries to the next row."""
    now, half, then = (
        travelled(t + part * dt, gains.speed, gains.ramp, manoeuvre.distance)
        for part in (0.0, 0.5, 1.0)
    )
    return manoeuvre.reference(now, half, (then - now) / dt)
