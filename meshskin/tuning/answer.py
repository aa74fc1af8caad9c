"""What the tuning found: gains, predicted manoeuvres, what binds; and its confirmation."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from ..core.se3 import Array
from ..scene.scene import Scene
from ..scene.settings import Exploration, Law
from ..simulation.response import ForceResponse, force_response
from ..simulation.simulate import simulate
from .gains import Gains, Scenario
from .manoeuvre import Manoeuvre
from .scenarios import world
from .shooting import Trajectory

BINDING = 1e-3
"""Multiplier, part of the objective, from which on a limit counts as binding."""


UNITS = {
    "gamma": "1/s",
    "force_reference": "N",
    "approach_speed": "m/s",
    "approach_ramp": "s",
    "settle": "s",
    "speed": "m/s",
    "ramp": "s",
}
"""Units of the gains; that of the velocity gain depends on the law's shape."""
RATES = {"inertia": "1/s", "identity": "N m s/rad"}


@dataclass(frozen=True)
class Confirmation:
    """A predicted manoeuvre beside the simulated one."""

    scenario: Scenario
    time: Array
    """(k,), s, from the start."""
    simulated: Array
    """Force (k,), N."""
    predicted: Array
    """Force (k,), N."""
    difference: float
    """Largest difference of the two, part of the reference force."""
    response: ForceResponse
    """Of the simulated force, from the touch to the begin of the slide."""
    error: float
    """RMS error of the simulated force over the slide, part of the force that the scene asks
    for."""


@dataclass(frozen=True, eq=False)
class Tuned:
    """Gains and speeds for a scene: `scene.with_(law=tuned.law, exploration=tuned.exploration)`."""

    scene: Scene
    """The scene that was tuned, with its own gains."""
    law: Law
    exploration: Exploration
    """With the speeds found: approach (in the law), rest, slide and its ramps."""
    objective: str
    """"time", "force_error" or "settling"."""
    value: float
    """Worst of the scenarios: s, or RMS error of the force as a part of the force asked for."""
    trajectories: tuple[Trajectory, ...]
    """The predicted manoeuvre in each scenario, the scene itself first."""
    multipliers: dict[str, float]
    """What a limit costs: decrease of the objective for a limit relaxed by its whole (overshoot and
    forces: by the reference force), and, for the range of a gain, for a range wider by e."""
    one_sided: dict[str, tuple[float, float]]
    """Limits at which the objective has a kink: what relaxing gains, and what tightening costs, in
    the multipliers' unit. The one multiplier of such a limit lies between the two, or beside."""
    left: float
    """What the slopes promise beyond the gains found, part of the objective. Where it is not small
    (0.002) the search ended in a tooth of the objective, and multipliers are no prices."""
    status: str
    """How the search ended: "solved", or where it stopped and why."""
    iterations: int
    build_seconds: float
    solve_seconds: float
    manoeuvres: tuple[Manoeuvre, ...]
    """The manoeuvre in each scenario, on the tuned scene."""
    place: Array
    """Where the slide begins (3,), body frame, m."""

    @property
    def binding(self) -> tuple[str, ...]:
        """The limits that hold the objective back, the dearest first."""
        dear = {k: v for k, v in self.multipliers.items() if v > BINDING * abs(self.value)}
        return tuple(sorted(dear, key=lambda name: -dear[name]))

    @property
    def tuned(self) -> Scene:
        """The scene with what was found."""
        return self.scene.with_(law=self.law, exploration=self.exploration)

    def __str__(self) -> str:
        """Objective, gains before and after, what binds, how the search ended, times foretold."""
        units = UNITS | {"rate": RATES[self.law.shape]}
        names = [field.name for field in fields(Gains)]
        pairs = zip(names, Gains.of(self.scene).values, Gains.of(self.tuned).values, strict=True)
        gains = [f"  {n:16}{a:>10.4g} -> {b:<10.4g}{units[n]}" for n, a, b in pairs]
        if self.objective == "force_error":
            value = f"{100 * self.value:.3g} % of the force asked for (RMS)"
        else:
            value = f"{self.value:.4g} s"
        times = (f"{t.scenario.name} {t.duration:.4g} s" for t in self.trajectories)
        held = [f"{k} (one-sided)" if k in self.one_sided else k for k in self.binding]
        return "\n".join(
            (
                f"Least {self.objective.replace('_', ' ')} of {self.scene.name}: {value}",
                *gains,
                f"Held back by: {', '.join(held) or 'no limit'}",
                f"The search: {self.status}",
                f"Foretold from the start to the end of the slide: {', '.join(times)}",
            )
        )

    __repr__ = __str__

    def confirm(self, which: int = 0) -> Confirmation:
        """Simulate the manoeuvre in scenario number `which`, on the body's own surface.

        Raises SimulationError where the simulator refuses it, ReachError where the arm cannot.
        """
        foretold, manoeuvre = self.trajectories[which], self.manoeuvres[which]
        lived = world(self.tuned, foretold.scenario, self.place)
        time, force = respond(lived, manoeuvre)
        count = min(len(force), len(foretold.force))
        reference = self.law.force_reference
        apart = np.abs(force[:count] - foretold.force[:count]).max()
        first = time[np.argmax(force > 0)] + self.exploration.settle
        resting = time <= first
        asked = self.scene.law.force_reference
        return Confirmation(
            foretold.scenario,
            time[:count],
            force[:count],
            foretold.force[:count],
            float(apart / reference),
            force_response(time[resting], force[resting], reference),
            float(np.sqrt(np.mean((force[~resting] / asked - 1.0) ** 2))),
        )


def respond(scene: Scene, manoeuvre: Manoeuvre) -> tuple[Array, Array]:
    """Time and force (k,) of a manoeuvre as `simulate` runs it with a scene's gains and speeds."""
    path = manoeuvre.path(scene.body, scene.exploration, scene.loop.dt)
    motion = simulate(scene.with_(effects=()), path=path).motion
    assert motion is not None  # a simulation always has one
    return motion.column("time").to_numpy(), motion.column("force").to_numpy()


def rounded(gains: Gains, dt: float) -> Gains:
    """`gains` as the simulator takes them: a rest of whole steps."""
    return replace(gains, settle=float(dt * np.ceil(gains.settle / dt - 1e-6)))
