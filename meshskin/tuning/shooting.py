"""Single shooting: a manoeuvre through the closed loop's own step, as a function of the gains.

The state is the step's, extended by the time since the first touch and the previous depth. The
slide begins when the rest after the touch is over, at whatever time that is, so that the manoeuvre
is a function of the gains without events. Between two steps the time of the touch is interpolated
from the depths. Torques are not limited here: the program has them as constraints, and within these
the simulator's torques are the same.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from ..core.arrays import Array
from ..core.codegen import compile_with_derivatives
from ..scene.scene import Scene
from ..simulation.closed_loop_model import ClosedLoopModel, state_of_pose
from ..simulation.integrators import step
from ..simulation.state_machine import approach_fraction
from .gains import NAMES, Gains
from .manoeuvre import Manoeuvre, slide_distance
from .scenarios import Scenario

MIN_DEPTH = 1e-12
"""Depth, m, added to a denominator that is 0 where two depths in a row are 0."""


@dataclass(frozen=True)
class Trajectory:
    """A predicted manoeuvre, one row a step."""

    scenario: Scenario
    time: Array
    """(k,), s, from the start at the standoff."""
    force: Array
    """(k,), N."""
    depth: Array
    """(k,), m; negative without contact."""
    since: Array
    """Time since the first touch (k,), s; 0 before it."""
    torque: Array
    """(k, n), N m; no columns without an arm."""
    q: Array
    """Joint angles (k, n), rad."""
    qdot: Array
    """Joint speeds (k, n), rad/s."""
    duration: float
    """From the start to the end of the slide, s."""


class SingleShooting:
    """The manoeuvre of one scenario as a function of the gains."""

    def __init__(self, scene: Scene, scenario: Scenario, manoeuvre: Manoeuvre) -> None:
        self.scene, self.scenario, self.manoeuvre = scene, scenario, manoeuvre
        loop = ClosedLoopModel.of(scene)
        unlimited = replace(loop.arm, effort_limit=np.full_like(loop.arm.effort_limit, np.inf))
        self.arm, self.loop = loop.arm, replace(loop, arm=unlimited)
        self.joints = loop.joints
        self.step = _extended_step(self.loop, manoeuvre)

    @property
    def start(self) -> Array:
        """Extended state at rest at the standoff."""
        start = self.manoeuvre.start
        q = state_of_pose(start) if self.loop.mode == "quasi_static" else start
        state = np.zeros(self.step.size1_in(0))
        state[: len(q)] = q
        state[-4:] = [*self.manoeuvre.foot, 0.0, -self.scene.exploration.standoff]
        return state

    def roll(self, gains: Any, steps: int) -> Any:
        """Rows `rows` of every step (m, steps), of CasADi gains (8,)."""
        compiled = isinstance(gains, ca.MX) and self.scene.loop.compile != "never"
        step = compile_with_derivatives(self.step, len(NAMES)) if compiled else self.step
        time = np.arange(steps, dtype=np.float64)[None] * self.loop.dt
        return step.mapaccum("shooting", steps)(self.start, ca.repmat(gains, 1, steps), time)[1]

    def rows(self) -> dict[str, slice]:
        """Slices of the rows of `roll` by name."""
        n = self.joints
        ends = np.cumsum([0, 1, 1, 1, n, n, n])
        names = ("force", "depth", "since", "torque", "q", "qdot")
        return {k: slice(a, b) for k, a, b in zip(names, ends[:-1], ends[1:], strict=True)}

    def predict(self, gains: Gains) -> Trajectory:
        """The manoeuvre with these gains, to the end of its slide."""
        slide = self.manoeuvre.distance / gains.speed + gains.ramp
        dt, standoff = self.loop.dt, self.scene.exploration.standoff
        approach = 2.0 * standoff / gains.approach_speed + 20.0 / gains.gamma + gains.approach_ramp
        steps = int(np.ceil((approach + gains.settle + slide) / dt)) + 2
        rolled = self.roll(ca.DM(gains.values), steps).full()
        since = rolled[self.rows()["since"]][0]
        before = int(np.argmax(since > 0)) if since.any() else steps
        duration = before * dt - (since[before] if before < steps else 0.0) + gains.settle + slide
        count = min(int(np.ceil(duration / dt)) + 1, steps)
        rows = {k: rolled[s, :count].T for k, s in self.rows().items()}
        rows |= {k: rows[k][:, 0] for k in ("force", "depth", "since")}
        time = np.arange(count, dtype=np.float64) * dt
        return Trajectory(scenario=self.scenario, time=time, duration=float(duration), **rows)


def _extended_step(loop: ClosedLoopModel, manoeuvre: Manoeuvre) -> ca.Function:
    """(state with time since the touch and previous depth, gains (8,), time) -> (next, row)."""
    inner = step(loop)
    size = inner.size1_in(0)
    state, vector = ca.SX.sym("state", size + 2), ca.SX.sym("gains", len(NAMES))
    time = ca.SX.sym("time")
    since, previous = state[size], state[size + 1]
    gains = Gains(*(vector[k] for k in range(len(NAMES))))
    reference = _reference(manoeuvre, since - gains.settle, gains, loop.dt)
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
    touching = ca.fmax(previous, 0.0) + ca.fmax(depth, 0.0)
    touching /= ca.fabs(previous) + ca.fabs(depth) + MIN_DEPTH
    since = since + loop.dt * touching
    row = ca.vertcat(
        output[rows["force"]], depth, since, output[rows["torque"]], state[:n], state[n : 2 * n]
    )
    following = ca.vertcat(after, since, depth)
    return ca.Function("one", [state, vector, time], [following, row], {"cse": True})


def _reference(manoeuvre: Manoeuvre, t: Any, gains: Gains, dt: float) -> Any:
    """The path's row (18,) `t` s after the slide's begin; the twist leads to the next row."""
    now, half, then = (
        slide_distance(t + part * dt, gains.speed, gains.ramp, manoeuvre.distance)
        for part in (0.0, 0.5, 1.0)
    )
    return manoeuvre.reference(now, half, (then - now) / dt)
