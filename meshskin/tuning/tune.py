"""`tune`: gains of the compliance law and speeds of the exploration by optimal control.

Direct single shooting: the manoeuvre (approach, touch, rest, slide) runs through the same step that
`simulate` runs, in every scenario, and a nonlinear program over the eight gains is solved by IPOPT
with derivatives by automatic differentiation.

Source: Betts, "Practical Methods for Optimal Control and Estimation Using Nonlinear Programming"
(2010), chapter 3; Waechter, Biegler, "On the implementation of an interior-point filter
line-search algorithm" (Math. Programming 106, 2006).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from ..core.arguments import check_name, check_real, check_type, repr_short
from ..core.arrays import Array
from ..core.errors import ConfigError, TuningError
from ..core.progress import Progress, Stage
from ..scene.scene import Scene
from ..simulation.response import force_response
from .gains import Demands, Gains, gain_bounds
from .limits import OBJECTIVES, Limit
from .manoeuvre import plan_manoeuvre, slide_start
from .problem import MAX_PREDICTED_DECREASE, SOLVED, TuningProblem, TuningSolution
from .result import TuningResult
from .scenarios import Scenario, scenario_scene, scenarios
from .shooting import SingleShooting

__all__ = ["Demands", "Scenario", "TuningResult", "scenarios", "tune"]

NOMINAL = Scenario()
"""The scenario that the scene itself describes."""
USUAL_ITERATIONS = 100
"""Iterations that all searches of a scene usually take together: 103 on sphere_noisy."""
HORIZON_MARGIN = 1.2
"""Length of the shooting over the duration of the first manoeuvre, so that a search may become
slower on its way."""
MAX_RESTARTS, RESTART_GAIN = 2, 1e-2
"""How often a search is restarted, and the relative gain of the last one that calls for it."""
FIRST_REST, TOUCH_REST = 1.5, 3.0
"""Rest at the start of the search over the settling time there; rest of a manoeuvre that is judged
by its touch alone over that at the start."""
MAX_RAMP_PART = 0.99
"""Largest part of the slide that its ramps take at the start of the search."""
MIN_APPROACH_RAMP = 0.02
"""Least time of the approach's ramp at the start of the search, s: twenty steps of 1 ms. The
derivative by a ramp of one or two steps vanishes."""


def tune(
    scene: Scene,
    *,
    objective: str = "time",
    demands: Demands | None = None,
    over: Scenario | Sequence[Scenario] = NOMINAL,
    distance: float = 0.02,
    place: ArrayLike | None = None,
    direction: ArrayLike | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    start: Gains | None = None,
    progress: Progress | None = None,
) -> TuningResult:
    """Choose gamma, L, f_ref and the speeds of a scene's closed loop over a manoeuvre.

    The body comes down from the standoff, touches the indenter, rests, and slides `distance` (m)
    along a geodesic from `place` (3,) in `direction` (3,), body frame; by default from the skin's
    centre along its first principal direction. objective: "time", the least duration of the
    manoeuvre; "force_error", the least RMS error of the force over the slide from the force that
    the scene asks for; or "settling", the least time from the touch until the force stays within
    `demands.settled` of its reference, with the slide of the scene. The worst of the scenarios
    `over` counts, and the demands hold in each (`scenarios` makes them from ranges). bounds: ranges
    of single gains, SI. start: first gains of the search; by default the scene's own. Delay, step,
    integrator and mode are those of `scene.loop`: a long step of low order damps, and gains may
    rely on it; "rk4" does not.

    progress("tune", done, total): called after each iteration of a search, whose number is not
    known before. Raises TuningError where no gains meet the demands, with the limit to relax and by
    how much, and for a place farther than 2 mm from the body; UnknownNameError, ConfigError for
    invalid arguments, ReachError where the arm cannot make the manoeuvre.
    """
    over, demands = check_scenarios(over), demands or Demands()
    _check(scene, objective, distance, demands, start)
    stage = Stage(progress, "tune", USUAL_ITERATIONS)
    point, ahead = slide_start(scene, place, direction)
    shootings = _shootings(scene, over, point, ahead, distance)
    first = start or _first_gains(shootings[0], Gains.of(scene))
    ranges = _ranges(shootings[0], objective, bounds or {}, first)
    first = Gains(*np.clip(first.values, *ranges).tolist())
    longest = max(shooting.predict(first).duration for shooting in shootings)
    if objective == "force_error" and demands.time is None:
        demands = replace(demands, time=longest + scene.loop.dt)  # the rest is rounded up
    horizon = _horizon(objective, demands, longest, distance / first.speed + first.ramp, first)
    search = _Search(shootings, first, ranges, int(np.ceil(horizon / scene.loop.dt)) + 2, stage)
    problem = search.problem(demands, objective)
    solution = search.solution(problem, demands, objective)
    stage.end()
    dt, gains = scene.loop.dt, solution.gains
    gains = replace(gains, settle=float(dt * np.ceil(gains.settle / dt - 1e-6)))
    heading = shootings[0].manoeuvre.heading
    finals = _shootings(gains.applied(scene), over, point, ahead, distance, heading)
    return TuningResult(
        **vars(solution) | {"gains": gains},
        scene=scene,
        objective=objective,
        trajectories=tuple(shooting.predict(gains) for shooting in finals),
        manoeuvres=tuple(shooting.manoeuvre for shooting in finals),
        place=point,
        build_seconds=problem.build_seconds,
    )


def _check(
    scene: Scene, objective: str, distance: float, demands: Demands, start: Gains | None
) -> None:
    """Raise UnknownNameError or ConfigError for arguments of `tune` that cannot be used."""
    check_name("objective", objective, OBJECTIVES)
    check_type(Scene, scene, "what is tuned")
    check_real("distance of the slide", distance, "m", above=0.0)
    check_type(Demands, demands, "demands")
    if start is not None:
        check_type(Gains, start, "start")


def check_scenarios(over: Scenario | Sequence[Scenario]) -> tuple[Scenario, ...]:
    """The scenarios as a tuple. Raises ConfigError where there is none."""
    if isinstance(over, Scenario):
        return (over,)
    if not isinstance(over, Sequence) or not over or not all(isinstance(w, Scenario) for w in over):
        raise ConfigError(
            "over must be scenarios",
            value=repr_short(over),
            limit="one Scenario or more",
            remedy="leave over= out for the scene alone, or give scenarios(modulus=(0.8, 1.2))",
        )
    return tuple(over)


@dataclass(frozen=True)
class _Search:
    """What the problems of a search share."""

    shootings: list[SingleShooting]
    first: Gains
    """The gains from which they begin."""
    ranges: Array
    """Lowest and highest gains (2, 8)."""
    steps: int
    """Steps of the closed loop."""
    stage: Stage

    def problem(self, demands: Demands, objective: str) -> TuningProblem:
        """The problem of an objective under demands."""
        force = self.shootings[0].scene.law.force_reference
        problem = TuningProblem(
            self.shootings, demands, objective, self.first, self.ranges, self.steps, force
        )
        problem.monitor.stage = self.stage
        return problem

    def solution(self, problem: TuningProblem, demands: Demands, objective: str) -> TuningSolution:
        """The solution of `problem`, from other gains where its first ones lead to none.

        Raises TuningError where no gains meet the demands.
        """
        solution = problem.solve()
        if not solution.slacks:
            return _polished(problem, solution)
        if demands.time is None or objective == "settling":
            return _from_nearest(problem)
        quickest = self.problem(replace(demands, time=None), "time")
        return _from_quickest(problem, quickest, demands.time, self.shootings[0].loop.dt)


def _from_nearest(problem: TuningProblem) -> TuningSolution:
    """The solution of a problem, from the gains that violate its limits least.

    Raises TuningError where these violate a limit.
    """
    nearest = problem.solve(elastic=True)
    if nearest.slacks:
        raise _infeasible(problem.limits, nearest.slacks)
    return _from(problem, nearest.gains)


def _from_quickest(
    problem: TuningProblem, quickest: TuningProblem, longest: float, dt: float
) -> TuningSolution:
    """The solution of a problem with a longest time, s, from the gains of the least time.

    Raises TuningError where that time, with the rest rounded up by a step `dt`, s, is longer.
    """
    found = quickest.solve()
    found = _from_nearest(quickest) if found.slacks else _polished(quickest, found)
    if found.value + dt > longest:
        raise TuningError(
            "no gains meet the demands",
            value=f"at best time of {found.value + dt:.4g} s",
            limit=f"{longest:.4g} s",
            remedy="relax the time, or the limits that bind it: "
            + ", ".join(name for name, value in found.multipliers.items() if value > 0),
        )
    return _from(problem, found.gains)


def _from(problem: TuningProblem, gains: Gains) -> TuningSolution:
    """The solution that is found from `gains`. Raises TuningError."""
    found = problem.solve(gains)
    if found.slacks:
        raise TuningError(
            f"the demands are not met: the search {found.status}",
            value=f"{max(found.slacks, key=lambda k: found.slacks[k])} violated",
            remedy="give start= nearer to the solution, or relax a limit",
        )
    return _polished(problem, found)


def _polished(problem: TuningProblem, solution: TuningSolution) -> TuningSolution:
    """A solution of a search that stopped early, improved from there.

    By descent along the limits, and by searches that leave the tooth in which that ends.
    """
    best = solution
    if best.predicted_decrease > MAX_PREDICTED_DECREASE:
        best = _better(best, problem.descend(best))
    for _ in range(MAX_RESTARTS):
        if best.status == SOLVED:
            break
        before = best.value
        again = problem.solve(best.gains)
        best = _better(best, again)
        if not again.slacks and again.predicted_decrease > MAX_PREDICTED_DECREASE:
            best = _better(best, problem.descend(again))
        if best.value > (1.0 - RESTART_GAIN) * before:
            break
    return best


def _better(one: TuningSolution, other: TuningSolution) -> TuningSolution:
    """The better of two solutions, with the iterations and the time of both."""
    best = other if not other.slacks and other.value < one.value else one
    return replace(
        best,
        iterations=one.iterations + other.iterations,
        solve_seconds=one.solve_seconds + other.solve_seconds,
    )


def _infeasible(limits: Mapping[str, Limit], slacks: Mapping[str, float]) -> TuningError:
    """The error that names the limits to relax and by how much, the most violated first."""

    def relaxed(name: str) -> str:
        limit = limits[name]
        needed = limit.bound + limit.relaxation * slacks[name]
        return f"{name} of {needed:.4g} {limit.unit}".rstrip()

    worst, *others = sorted(slacks, key=lambda name: -slacks[name])
    bound = f"{limits[worst].bound:.4g} {limits[worst].unit}".rstrip()
    also = f"; with it {', '.join(relaxed(name) for name in others)}" if others else ""
    return TuningError(
        "no gains meet the demands",
        value=f"at best {relaxed(worst)}",
        limit=bound,
        remedy=f"relax the {worst}{also}",
    )


def _shootings(
    scene: Scene,
    over: Sequence[Scenario],
    place: Array,
    direction: Array,
    distance: float,
    heading: float | None = None,
) -> list[SingleShooting]:
    """The manoeuvre in each scenario, on the same heading."""
    shootings: list[SingleShooting] = []
    for scenario in dict.fromkeys(over):
        varied = scenario_scene(scene, scenario, place)
        manoeuvre = plan_manoeuvre(varied, place / scenario.curvature, direction, distance, heading)
        heading = manoeuvre.heading
        shootings.append(SingleShooting(varied, scenario, manoeuvre))
    return shootings


def _ranges(
    shooting: SingleShooting,
    objective: str,
    bounds: Mapping[str, tuple[float, float]],
    first: Gains,
) -> Array:
    """Lowest and highest gains (2, 8); equal for gains without influence on the objective."""
    force, dt = shooting.scene.law.force_reference, shooting.loop.dt
    fixed: dict[str, float] = {}
    if shooting.joints == 0:  # without an arm: neither a velocity gain nor a jerk of torques
        own = shooting.scene.exploration.approach_ramp
        fixed |= {"rate": first.rate, "approach_ramp": max(own, dt)}
    if objective == "settling":
        fixed |= {"speed": first.speed, "ramp": first.ramp}
        bounds = {"force_reference": (force, force)} | dict(bounds)
    return gain_bounds(dict(bounds) | {name: (v, v) for name, v in fixed.items()}, force)


def _horizon(objective: str, demands: Demands, longest: float, slide: float, first: Gains) -> float:
    """Length of the shooting, s: the first manoeuvre or the time demanded, with a margin; for a
    search that is judged by the touch alone, without the slide."""
    horizon = HORIZON_MARGIN * longest
    if objective == "force_error" and demands.time:
        horizon = max(horizon, HORIZON_MARGIN * demands.time)
    if objective == "settling":
        horizon -= HORIZON_MARGIN * (slide - TOUCH_REST * first.settle)
    return horizon


def _first_gains(shooting: SingleShooting, gains: Gains) -> Gains:
    """The first gains of a search: a rest no longer than the settling needs, a slow ramp of the
    approach, ramps of the slide that fit into it."""
    gains = replace(
        gains,
        approach_ramp=max(gains.approach_ramp, MIN_APPROACH_RAMP),
        ramp=min(gains.ramp, MAX_RAMP_PART * shooting.manoeuvre.distance / gains.speed),
    )
    predicted = shooting.predict(gains)
    resting = predicted.since <= gains.settle
    response = force_response(
        predicted.time[resting], predicted.force[resting], gains.force_reference
    )
    if not np.isfinite(response.settling):
        return gains
    return replace(gains, settle=min(gains.settle, FIRST_REST * response.settling))
