"""The result of a tuning: gains, predicted manoeuvres, active limits; and its confirmation."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from ..core import arrow
from ..core.arrays import Array
from ..core.value import Value
from ..scene.scene import Scene
from ..scene.settings import Exploration, Law
from ..simulation.response import ForceResponse, force_response
from ..simulation.simulate import simulate
from .gains import Gains
from .manoeuvre import Manoeuvre
from .problem import TuningSolution
from .scenarios import Scenario, scenario_scene
from .shooting import Trajectory

BINDING = 1e-3
"""Multiplier, relative to the objective, from which on a limit is listed as binding: relaxing it by
all of its unit gains more than problem.MIN_GAIN."""
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
RATE_UNITS = {"inertia": "1/s", "identity": "N m s/rad"}
"""Unit of the velocity gain by the law's shape."""


@dataclass(frozen=True, eq=False)
class Confirmation(Value):
    """A predicted manoeuvre beside the simulated one."""

    scenario: Scenario
    time: Array
    """(k,), s, from the start."""
    simulated: Array
    """Force (k,), N."""
    predicted: Array
    """Force (k,), N."""
    difference: float
    """Largest difference of the two forces, relative to the reference force."""
    response: ForceResponse
    """Of the simulated force, from the touch to the begin of the slide."""
    error: float
    """RMS error of the simulated force over the slide, relative to the force that the scene asks
    for."""


@dataclass(frozen=True, eq=False, repr=False)
class TuningResult(TuningSolution):
    """Gains and speeds for a scene; `tuned_scene` is the scene with them.

    `gains` and `trajectories` have a rest that is rounded up to whole steps, as the simulator has
    it; `value` is that of the rest before. Multipliers are the decrease of the objective for a
    limit relaxed by 1 (overshoot and forces: by the reference force), by a whole limit that has a
    unit, or, for the range of a gain, for a range wider by the factor e. Where the predicted
    decrease is not small (0.002) the search ended at a kink, and they are not valid.
    """

    scene: Scene
    """The scene that was tuned, with its own gains."""
    objective: str
    """"time", "force_error" or "settling"."""
    trajectories: tuple[Trajectory, ...]
    """The predicted manoeuvre in each scenario, the scene itself first."""
    manoeuvres: tuple[Manoeuvre, ...]
    """The manoeuvre in each scenario, on the tuned scene."""
    place: Array
    """Where the slide begins (3,), body frame, m."""
    build_seconds: float

    @property
    def tuned_scene(self) -> Scene:
        """The scene with the gains and speeds found."""
        return self.gains.applied(self.scene)

    @property
    def law(self) -> Law:
        """The compliance law found."""
        return self.tuned_scene.law

    @property
    def exploration(self) -> Exploration:
        """The exploration with the rest, the slide's speed and the ramps found."""
        return self.tuned_scene.exploration

    @property
    def binding(self) -> tuple[str, ...]:
        """The limits that bind, the largest multiplier first."""
        found = {k: v for k, v in self.multipliers.items() if v > BINDING * abs(self.value)}
        return tuple(sorted(found, key=lambda name: -found[name]))

    def __str__(self) -> str:
        """Objective, gains before and after, binding limits, status, predicted durations."""
        units = UNITS | {"rate": RATE_UNITS[self.law.shape]}
        names = [field.name for field in fields(Gains)]
        before, after = (Gains.of(scene).values for scene in (self.scene, self.tuned_scene))
        gains = [
            f"  {name:16}{a:>10.4g} -> {b:<10.4g}{units[name]}"
            for name, a, b in zip(names, before, after, strict=True)
        ]
        if self.objective == "force_error":
            value = f"{100 * self.value:.3g} % of the force asked for (RMS)"
        else:
            value = f"{self.value:.4g} s"
        times = (f"{t.scenario.name} {t.duration:.4g} s" for t in self.trajectories)
        binding = [f"{k} (one-sided)" if k in self.one_sided else k for k in self.binding]
        return "\n".join(
            (
                f"Least {self.objective.replace('_', ' ')} of {self.scene.name}: {value}",
                *gains,
                f"Binding limits: {', '.join(binding) or 'none'}",
                f"Search: {self.status}",
                f"Predicted duration to the end of the slide: {', '.join(times)}",
            )
        )

    def __repr__(self) -> str:
        return str(self)

    def confirm(self, which: int = 0) -> Confirmation:
        """Simulate the manoeuvre in scenario number `which`, on the body's own surface.

        Raises SimulationError where the simulation fails, ReachError where the arm cannot follow.
        """
        predicted, manoeuvre = self.trajectories[which], self.manoeuvres[which]
        scene = scenario_scene(self.tuned_scene, predicted.scenario, self.place)
        time, force = simulate_manoeuvre(scene, manoeuvre)
        count = min(len(force), len(predicted.force))
        reference, asked = self.law.force_reference, self.scene.law.force_reference
        difference = np.abs(force[:count] - predicted.force[:count]).max()
        resting = time <= time[np.argmax(force > 0)] + self.exploration.settle
        return Confirmation(
            scenario=predicted.scenario,
            time=time[:count],
            simulated=force[:count],
            predicted=predicted.force[:count],
            difference=float(difference / reference),
            response=force_response(time[resting], force[resting], reference),
            error=float(np.sqrt(np.mean((force[~resting] / asked - 1.0) ** 2))),
        )


def simulate_manoeuvre(scene: Scene, manoeuvre: Manoeuvre) -> tuple[Array, Array]:
    """Time (k,), s, and force (k,), N, of a manoeuvre by `simulate`, with the scene's gains."""
    path = manoeuvre.path(scene.body, scene.exploration, scene.loop.dt)
    motion = simulate(scene.with_(effects=()), path=path).motion
    assert motion is not None  # a simulation always has one
    return arrow.values(motion.column("time")), arrow.values(motion.column("force"))
