"""The door: gains of the compliance law and speeds of the exploration by optimal control.

Direct single shooting: the manoeuvre (approach, touch, rest, slide) is rolled out through the very
step that `simulate` runs, in every scenario, and a nonlinear program over the seven gains is solved
by IPOPT with derivatives by automatic differentiation.

Source: Betts, "Practical Methods for Optimal Control and Estimation Using Nonlinear Programming"
(2010), chapter 3; Waechter, Biegler, "On the implementation of an interior-point filter
line-search algorithm" (Math. Programming 106, 2006).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from ..core.arguments import check_real, check_type, repr_short
from ..core.errors import ConfigError, TuningError, UnknownNameError
from ..core.se3 import Array
from ..scene.scene import Scene
from ..simulation.response import force_response
from . import manoeuvre as manoeuvres
from .answer import Tuned, rounded
from .convergence import SOLVED
from .gains import Demands, Gains, Scenario, scenarios, span
from .limits import OBJECTIVES, Limit
from .manoeuvre import Manoeuvre
from .problem import LEFT, TuningProblem, TuningSolution
from .scenarios import world
from .shooting import ShootingInterval

__all__ = ["Demands", "Scenario", "Tuned", "scenarios", "tune"]

NOMINAL = Scenario()
"""The world that the scene itself describes."""
LEEWAY = 1.2
"""Length of the rollout over the time of the start's manoeuvre."""
ROUNDS, WORTH = 2, 1e-2
"""How often a search is taken up again, and the gain of the last one that calls for it."""
REST, HELD = 1.5, 3.0
"""Rest at the start of the search, over the settling time there; that of a shot that is judged by
its touch alone, over the one at the start."""
SHARE = 0.99
"""Most of the slide that its ramps may take, at the start."""
GENTLE = 0.02
"""Least time of the approach's ramp at the start of the search, s: shorter ones, of a step or two,
have no slope."""


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
) -> Tuned:
    """Choose gamma, L, f_ref and the speeds of a scene's closed loop over a manoeuvre.

    The body comes down from the standoff, touches the indenter, rests, and slides `distance` (m)
    along a geodesic from `place` (3,) in `direction` (3,), body frame; by default from the skin's
    centre along its first principal direction. objective: "time", the least time of it all;
    "force_error", the least RMS error of the force over the slide from the force that the scene
    asks for; or "settling", the least time from the touch until the force stays within
    `demands.settled` of its reference, the slide as the scene has it. The worst of the scenarios
    `over` counts, and the demands hold in each (`scenarios` makes them from ranges). bounds: ranges
    of single gains, SI. start: where the search begins; by default from the scene's own gains.
    Delay, step, integrator and mode are those of `scene.loop`: a long step of low order damps, and
    gains may come to count on it; "rk4" does not.

    Raises TuningError where no gains meet the demands, naming the limit to relax and how far;
    UnknownNameError, ConfigError for arguments that cannot be, ReachError where the arm cannot make
    the manoeuvre.
    """
    if objective not in OBJECTIVES:
        raise UnknownNameError("objective", objective, OBJECTIVES)
    check_type(Scene, scene, "what is tuned")
    check_real("distance of the slide", distance, "m", above=0.0)
    over = worlds(over)
    demands = demands or Demands()
    check_type(Demands, demands, "demands")
    if start is not None:
        check_type(Gains, start, "start")
    spot, ahead = manoeuvres.where(scene, place, direction)
    shots = _shots(scene, over, spot, ahead, distance)
    target = scene.law.force_reference
    first = start or _rested(shots[0], Gains.of(scene))
    ranges = _ranges(shots[0], objective, bounds or {}, first)
    first = Gains(*np.clip(first.values, *ranges).tolist())
    longest = max(shot.predict(first).duration for shot in shots)
    if objective == "force_error" and demands.time is None:
        demands = replace(demands, time=longest)
    horizon = _horizon(objective, demands, longest, distance / first.speed + first.ramp, first)
    steps = int(np.ceil(horizon / scene.loop.dt)) + 2

    def posed(demands: Demands, objective: str) -> TuningProblem:
        return TuningProblem(shots, demands, objective, first, ranges, steps, target)

    problem = posed(demands, objective)
    if demands.time is None or objective == "settling":
        solution = _solved(problem)
    else:
        solution = _in_time(
            problem, demands.time, lambda: posed(replace(demands, time=None), "time")
        )
    gains = rounded(solution.gains, scene.loop.dt)
    applied = gains.applied(scene)
    finals = _shots(applied, over, spot, ahead, distance, shots[0].manoeuvre.heading)
    return Tuned(
        scene=scene,
        law=applied.law,
        exploration=applied.exploration,
        objective=objective,
        value=solution.value,
        trajectories=tuple(shot.predict(gains) for shot in finals),
        multipliers=solution.multipliers,
        one_sided=solution.one_sided,
        left=solution.left,
        status=solution.status,
        iterations=solution.iterations,
        build_seconds=problem.build_seconds,
        solve_seconds=solution.seconds,
        manoeuvres=tuple(shot.manoeuvre for shot in finals),
        place=spot,
    )


def worlds(over: Scenario | Sequence[Scenario]) -> tuple[Scenario, ...]:
    """The worlds that gains must serve. Raises ConfigError where there is none."""
    if isinstance(over, Scenario):
        return (over,)
    if not isinstance(over, Sequence) or not over or not all(isinstance(w, Scenario) for w in over):
        raise ConfigError(
            "the worlds to tune over",
            value=repr_short(over),
            limit="one Scenario or more",
            remedy="leave over= out for the scene alone, or give scenarios(modulus=(0.8, 1.2))",
        )
    return tuple(over)


def _solved(problem: TuningProblem) -> TuningSolution:
    """The solution of a problem that has one. Raises TuningError where it has none."""
    solution = problem.solve()
    if not solution.slacks:
        return _polished(problem, solution)
    nearest = problem.solve(elastic=True)
    if nearest.slacks:
        raise _infeasible(problem.limits, nearest.slacks)
    return _from(problem, nearest.gains)


def _from(problem: TuningProblem, gains: Gains) -> TuningSolution:
    """The solution that is found from other gains than the first. Raises TuningError."""
    found = problem.solve(gains)
    if found.slacks:
        raise TuningError(
            f"the demands are not met: the search {found.status}",
            value=f"{max(found.slacks, key=lambda k: found.slacks[k])} broken",
            remedy="give start= nearer to the solution, or relax a limit",
        )
    return _polished(problem, found)


def _in_time(
    problem: TuningProblem, longest: float, timeless: Callable[[], TuningProblem]
) -> TuningSolution:
    """The solution of a problem with a longest time, s: found from the least time that there is,
    where the way to it is not found at once. Raises TuningError where that is longer.
    """
    solution = problem.solve()
    if not solution.slacks:
        return _polished(problem, solution)
    quickest = _solved(timeless())
    if quickest.value > longest:
        raise TuningError(
            "no gains meet the demands",
            value=f"at best time of {quickest.value:.4g} s",
            limit=f"{longest:.4g} s",
            remedy="relax the time, or what binds it: "
            + ", ".join(name for name, price in quickest.multipliers.items() if price > 0),
        )
    return _from(problem, quickest.gains)


def _polished(problem: TuningProblem, solution: TuningSolution) -> TuningSolution:
    """A solution that was left for want of progress, searched on from where it was.

    Downhill along the limits, and by searches that leave the tooth in which that ends.
    """
    best = _lower(solution, problem.descend(solution)) if solution.left > LEFT else solution
    for _ in range(ROUNDS):
        if best.status == SOLVED:
            break
        before = best.value
        again = problem.solve(best.gains)
        best = _lower(best, again)
        if not again.slacks and again.left > LEFT:
            best = _lower(best, problem.descend(again))
        if best.value > (1.0 - WORTH) * before:
            break
    return best


def _lower(one: TuningSolution, other: TuningSolution) -> TuningSolution:
    """The better of two solutions, with the iterations and the time of both."""
    best = other if not other.slacks and other.value < one.value else one
    iterations, seconds = one.iterations + other.iterations, one.seconds + other.seconds
    return replace(best, iterations=iterations, seconds=seconds)


def _infeasible(limits: Mapping[str, Limit], slacks: Mapping[str, float]) -> TuningError:
    """The error that says which limits to relax, and how far; the one farthest broken first."""

    def relaxed(name: str) -> str:
        limit = limits[name]
        needed = limit.bound + limit.whole * slacks[name]
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


def _shots(
    scene: Scene,
    over: Sequence[Scenario],
    place: Array,
    direction: Array,
    distance: float,
    heading: float | None = None,
) -> list[ShootingInterval]:
    """The manoeuvre in each scenario, on the same heading."""
    shots: list[ShootingInterval] = []
    for scenario in dict.fromkeys(over):
        lived = world(scene, scenario, place)
        made: Manoeuvre = manoeuvres.plan(
            lived, place / scenario.curvature, direction, distance, heading
        )
        heading = made.heading
        shots.append(ShootingInterval(lived, scenario, made))
    return shots


def _ranges(
    shot: ShootingInterval, objective: str, bounds: Mapping[str, tuple[float, float]], first: Gains
) -> Array:
    """Lowest and highest gains (2, 8): one value for those that the objective does not call for."""
    target, dt = shot.scene.law.force_reference, shot.loop.dt
    fixed: dict[str, float] = {}
    if shot.joints == 0:  # without an arm: neither a velocity gain nor a jerk of torques
        own = shot.scene.exploration.approach_ramp
        fixed |= {"rate": first.rate, "approach_ramp": max(own, dt)}
    if objective == "settling":
        fixed |= {"speed": first.speed, "ramp": first.ramp}
        bounds = {"force_reference": (target, target)} | dict(bounds)
    return span(dict(bounds) | {name: (value, value) for name, value in fixed.items()}, target)


def _horizon(objective: str, demands: Demands, longest: float, slide: float, first: Gains) -> float:
    """Length of the rollout, s: with leeway over the start's manoeuvre, s, and a time demanded; a
    search that is judged by the touch ends soon after it, without the slide, s.
    """
    horizon = LEEWAY * longest
    if objective == "force_error" and demands.time:
        horizon = max(horizon, LEEWAY * demands.time)
    if objective == "settling":
        horizon -= LEEWAY * (slide - HELD * first.settle)
    return horizon


def _rested(shot: ShootingInterval, gains: Gains) -> Gains:
    """`gains` as a search begins: no more rest than their own settling calls for, an approach begun
    gently, ramps of a slide that has room for them."""
    longest = SHARE * shot.manoeuvre.distance / gains.speed
    gains = replace(
        gains,
        approach_ramp=max(gains.approach_ramp, GENTLE),
        ramp=min(gains.ramp, longest),
    )
    foretold = shot.predict(gains)
    resting = foretold.since <= gains.settle
    response = force_response(
        foretold.time[resting], foretold.force[resting], gains.force_reference
    )
    if not np.isfinite(response.settling):
        return gains
    return replace(gains, settle=min(gains.settle, REST * response.settling))
