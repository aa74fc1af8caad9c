"""The tuning as one nonlinear program over all scenarios, solved by IPOPT.

    min  log value + WEIGHT |x - x_0|^2      subject to  limit_i(x) <= bound_i + scale_i slack_i

x are the logarithms of the gains, `value` the worst of the scenarios: the time, or the RMS error of
the force over the slide. Each limit is the largest of a quantity in windows of WINDOW steps, so
that a handful of constraints stand for thousands. The slacks are zero, but in the elastic problem,
which minimises their sum to find out what stands in the way.

Source of the elastic mode: Gill, Murray, Saunders, "SNOPT", SIAM Review 47(1), 2005, section 1.2.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import casadi as ca
import numpy as np
from scipy.optimize import nnls

from ..motion.stability import TOUCH
from ..se3 import Array
from .gains import NAMES, Demands, Gains
from .shooting import Shot
from .watch import BROKEN, Watch

OBJECTIVES = ("time", "force_error")
WINDOW = 20
"""Steps whose largest value is one constraint."""
WEIGHT = 1e-5
"""Pull towards the start, that gains which matter to nothing rest."""
ELASTIC = 1e3
"""Cost of a slack of 1 in the elastic problem, over that of the objective."""
DAMPING = 1.0
"""Curvature given to the program for the least time: limits and time are nearly linear in the
logarithms of the gains, the solution is a corner of limits, and a plain proximal term gets there in
fewer steps than quasi-Newton or exact second derivatives (measured: 50, 100 and over 100)."""
TOLERANCE = 1e-3
"""Largest violation of a limit, in its scale, of a solution that is taken."""
TOUCHED = 2e-3
"""Distance from a limit, in its scale, or from the end of a range, below which it is touched."""
SAFE = 0.97
"""Part of the touch's depth on which its step is judged, as Hertz scales it with the force."""
OPTIONS: dict[str, Any] = {
    "print_time": False,
    "show_eval_warnings": False,  # a step too far is unstable: IPOPT takes a shorter one
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "ipopt.mu_strategy": "adaptive",
    "ipopt.tol": 1e-5,
    "ipopt.max_iter": 200,
}


@dataclass(frozen=True)
class Limit:
    """A quantity (k,) that must not exceed its bound."""

    name: str
    quantity: ca.MX
    bound: float
    scale: float
    """What a slack of 1 adds to the bound."""
    unit: str


@dataclass(frozen=True)
class Solution:
    """Where the solver ended."""

    gains: Gains
    value: float
    """Objective: s, or part of the reference force."""
    slacks: dict[str, float]
    """How far each limit is broken, in its scale; empty where none is."""
    multipliers: dict[str, float]
    """By limit: what a relaxation by its scale gains in the objective; by gain: what its bound
    holds back, for a change by the factor e."""
    status: str
    iterations: int
    seconds: float


class Problem:
    """The program for some shots (scenarios), `steps` steps of the closed loop long."""

    def __init__(
        self,
        shots: Sequence[Shot],
        demands: Demands,
        objective: str,
        start: Gains,
        span: Array,
        steps: int,
        target: float,
    ) -> None:
        began = perf_counter()
        self.shots, self.demands, self.objective = shots, demands, objective
        self.steps, self.target = steps + -steps % WINDOW, target
        self.span, (self.low, self.high) = span, np.log(span)
        self.first = np.clip(np.log(np.array(start.values, dtype=float)), self.low, self.high)
        x = ca.MX.sym("x", len(NAMES))
        gains = Gains(*(ca.exp(x[k]) for k in range(len(NAMES))))
        limits: dict[str, list[Limit]] = {}
        values = []
        for shot in shots:
            value, found = self._limits(shot, gains)
            values.append(value)
            for limit in found:
                limits.setdefault(limit.name, []).append(limit)
        self.limits = {name: found[0] for name, found in limits.items()}
        self.names = list(limits)
        slack, worst = ca.MX.sym("slack", len(self.names)), ca.MX.sym("worst")
        weight = ca.MX.sym("weight", 2)
        self._unit = self._first_value(values, x)
        g = [ca.log(value / self._unit) - worst for value in values]
        rows = [-1] * len(values)
        for k, found in enumerate(limits.values()):
            for one in found:
                g.append((one.quantity - one.bound) / one.scale - slack[k])
                rows += [k] * one.quantity.shape[0]
        self._rows = np.array(rows)
        self._some = self._rows >= 0  # the others are the objectives
        cost = weight[0] * (worst + WEIGHT * ca.sumsqr(x - self.first))
        nlp = {
            "x": ca.vertcat(x, worst, slack),
            "p": weight,
            "f": cost + weight[1] * ca.sum1(slack),
            "g": ca.vertcat(*g),
        }
        self.nlp = nlp
        self._slopes = ca.Function(
            "slopes",
            [nlp["x"], nlp["p"]],
            [ca.gradient(nlp["f"], nlp["x"]), ca.jacobian(nlp["g"], nlp["x"])],
        )
        self.watch = Watch(nlp["x"].shape[0], nlp["g"].shape[0])
        made: dict[str, Any] = {"iteration_callback": self.watch}
        if objective == "time":
            made["hess_lag"] = _damping(nlp)
        else:  # the logarithm of an error that may vanish is bent: it needs its curvature
            made["ipopt.hessian_approximation"] = "limited-memory"
        self.solver = ca.nlpsol("tune", "ipopt", nlp, OPTIONS | made)
        self.build_seconds = perf_counter() - began

    def solve(self, start: Gains | None = None, elastic: bool = False) -> Solution:
        """The solution from `start`; elastic: with slacks, at the least sum of them."""
        began = perf_counter()
        many = len(self.names)
        first = self.first if start is None else np.log(np.array(start.values, dtype=float))
        guess = np.concatenate([first, [0.0], np.full(many, 0.1 if elastic else 0.0)])
        self.watch.begin((lambda x, g: float(self._broken(x, g).sum())) if elastic else self._merit)
        self.solver(
            x0=guess,
            p=[1.0 / ELASTIC, 1.0] if elastic else [1.0, 0.0],
            lbx=np.concatenate([self.low, [-np.inf], np.zeros(many)]),
            ubx=np.concatenate([self.high, [np.inf], np.full(many, np.inf if elastic else 0.0)]),
            lbg=-np.inf,
            ubg=0.0,
        )
        stats, best = self.solver.stats(), self.watch.best
        assert best is not None  # the start is an iterate
        size = len(NAMES)
        over, pulls = self._broken(best.x, best.g), self._multipliers(best.x, best.g)
        value = self._value(best.x, best.g) * self._unit
        return Solution(
            gains=Gains(*np.clip(np.exp(best.x[:size]), *self.span).tolist()),
            value=value,
            slacks={n: float(v) for n, v in zip(self.names, over, strict=True) if v > TOLERANCE},
            multipliers={n: float(v * value) for n, v in pulls.items()},
            status=stats["return_status"],
            iterations=int(stats["iter_count"]),
            seconds=perf_counter() - began,
        )

    def _multipliers(self, x: Array, g: Array) -> dict[str, float]:
        """Multipliers of the limits and ranges that an iterate touches, in the program's units.

        By non-negative least squares on the stationarity of the Lagrangian, so that they depend
        neither on the solver's barrier nor on where it stopped.
        """
        size = len(NAMES)
        cost, slopes = (np.array(s) for s in self._slopes(x, [1.0, 0.0]))
        worst = len(self.shots)
        above = g.copy()
        above[:worst] -= g[:worst].max()  # the worst scenario counts, wherever its bound was left
        touched = np.flatnonzero(above > -TOUCHED)
        ends = np.concatenate([self.low - x[:size], x[:size] - self.high]) > -TOUCHED
        walls = np.concatenate([-np.eye(size), np.eye(size)])[ends]
        walls = np.concatenate([walls, np.zeros((len(walls), 1))], axis=1)
        columns = np.concatenate([slopes[touched, : size + 1], walls]).T
        pull = nnls(columns, -cost.ravel()[: size + 1])[0]
        names = [self.names[k] if k >= 0 else "" for k in self._rows[touched]]
        names += [f"range of {name}" for name in np.array([*NAMES, *NAMES])[ends]]
        found: dict[str, float] = {}
        for name, value in zip(names, pull, strict=True):
            found[name] = found.get(name, 0.0) + float(value)
        found.pop("", None)  # the scenarios' shares of the objective
        return found

    def _value(self, x: Array, g: Array) -> float:
        """The objective, in its unit, at an iterate: the worst of the scenarios."""
        return float(np.exp(x[len(NAMES)] + g[: len(self.shots)].max()))

    def _broken(self, x: Array, g: Array) -> Array:
        """How far each limit is broken at an iterate, in its scale; at least 0."""
        over, rows = np.zeros(len(self.names)), self._rows[self._some]
        np.maximum.at(over, rows, g[self._some] + x[len(NAMES) + 1 :][rows])
        return over

    def _merit(self, x: Array, g: Array) -> float:
        """Of a point on the way to the solution: any that meets the limits is better than none."""
        over = float(self._broken(x, g).max())
        return self._value(x, g) if over < 0.5 * TOLERANCE else BROKEN * (1.0 + over)

    def _first_value(self, values: Sequence[ca.MX], x: ca.MX) -> float:
        """The objective at the start: its unit in the program."""
        at = ca.Function("values", [x], [ca.vertcat(*values)])(self.first)
        return float(np.abs(at.full()).max())

    def _limits(self, shot: Shot, gains: Gains) -> tuple[ca.MX, list[Limit]]:
        """The objective of one scenario, and its limits."""
        demands, target, dt = self.demands, self.target, shot.loop.dt
        rolled = shot.roll(ca.vertcat(*gains.values), self.steps)
        row = {name: rolled[s, :] for name, s in shot.rows().items()}
        force, since = row["force"].T, row["since"].T
        reference = gains.force_reference
        error = force / reference - 1.0
        slide = shot.manoeuvre.distance / gains.speed + gains.ramp
        duration = (self.steps - 1) * dt - since[-1] + gains.settle + slide
        settled = interpolated(error, since, gains.settle, dt)
        # before the slide's begin, a rising force is not yet asked to be there
        rising = ca.fmin(ca.fmax((gains.settle - since) / (2.0 * dt), 0.0), 1.0)
        horizon = (self.steps - 1) * dt
        longest = horizon if demands.time is None else min(demands.time, horizon)
        found = [
            Limit("overshoot", windows(error), demands.overshoot, 1.0, ""),
            Limit("settled", ca.vertcat(settled, -settled), demands.settled, 1.0, ""),
            Limit("least force", windows(1.0 - force / target - rising), demands.force, 1.0, ""),
            Limit("largest force", windows(force / target - 1.0 - rising), demands.force, 1.0, ""),
            Limit("time", duration, longest, longest, "s"),
            Limit("ramp", gains.ramp * gains.speed / shot.manoeuvre.distance, 0.999, 1.0, ""),
            *self._step_limit(shot, gains),
            *self._joint_limits(shot, row),
        ]
        if self.objective == "time":
            return duration, found
        t = since - gains.settle
        sliding = _step(t / dt) * _step((slide - t) / dt)
        squares = ca.sum1(sliding * (force / target - 1.0) ** 2) / ca.sum1(sliding)
        return ca.sqrt(squares + 1e-12), found

    def _step_limit(self, shot: Shot, gains: Gains) -> Iterator[Limit]:
        """The touch must be resolved by the steps: stability.touch_limit, on its safe side."""
        part = TOUCH[shot.loop.integrator if shot.joints else "semi_implicit"]
        if not np.isfinite(part):
            return
        depth = ca.MX(float(shot.scene.patch.depth))
        depth *= SAFE * (gains.force_reference / shot.scene.law.force_reference) ** (2.0 / 3.0)
        speed = ca.fmin(gains.approach_speed, 8.0 / 3.0 * gains.gamma * depth)
        yield Limit("step of the loop", speed * shot.loop.dt / (part * depth), 1.0, 1.0, "")

    def _joint_limits(self, shot: Shot, row: dict[str, ca.MX]) -> Iterator[Limit]:
        arm, demands = shot.arm, self.demands
        for j, name in enumerate(arm.joint_names[: shot.joints]):
            for kind, key, limit, share in (
                ("torque", "torque", arm.effort_limit[j], demands.torque),
                ("speed", "qdot", arm.velocity_limit[j], demands.velocity),
            ):
                if np.isfinite(limit):
                    unit = "N m" if kind == "torque" else "rad/s"
                    most = windows(ca.fabs(row[key][j, :].T))
                    yield Limit(f"{kind} of {name}", most, float(share * limit), float(limit), unit)
            low, high = arm.lower[j] + demands.position, arm.upper[j] - demands.position
            if np.isfinite(low) and np.isfinite(high):
                middle, half = 0.5 * (low + high), 0.5 * (high - low)
                away = windows(ca.fabs(row["q"][j, :].T - middle))
                yield Limit(f"position of {name}", away, float(half), float(half), "rad")


def _damping(nlp: dict[str, ca.MX]) -> ca.Function:
    """DAMPING on the gains in place of the Hessian of the Lagrangian."""
    x, p, weight = nlp["x"], nlp["p"], ca.MX.sym("lam_f")
    pull = ca.MX.sym("lam_g", nlp["g"].shape[0])
    rest = x.shape[0] - len(NAMES)
    hessian = ca.sparsify(ca.diag(ca.DM([DAMPING] * len(NAMES) + [0.0] * rest)))
    return ca.Function(
        "damping",
        [ca.MX.sym("x", x.shape[0]), ca.MX.sym("p", p.shape[0]), weight, pull],
        [ca.MX(hessian) * weight],
        ["x", "p", "lam_f", "lam_g"],
        ["triu_hess_gamma_x_x"],
    )


def windows(values: ca.MX) -> ca.MX:
    """Largest of `values` (k WINDOW,) in each window (k,)."""
    count = values.shape[0] // WINDOW
    return ca.vertcat(*(ca.mmax(values[k * WINDOW : (k + 1) * WINDOW]) for k in range(count)))


def interpolated(values: ca.MX, times: ca.MX, at: Any, dt: float) -> ca.MX:
    """`values` (k,) at equidistant `times` (k,), at one time: by cubic convolution.

    Source: Keys, "Cubic convolution interpolation" (IEEE Trans. ASSP 29(6), 1981).
    """
    u = ca.fabs(times - at) / dt
    near, far = 1.0 + u * u * (1.5 * u - 2.5), 2.0 + u * (-4.0 + u * (2.5 - 0.5 * u))
    return ca.sum1(ca.if_else(u < 1.0, near, ca.if_else(u < 2.0, far, 0.0)) * values)


def _step(t: ca.MX) -> ca.MX:
    """0 before -1/2, 1 after 1/2."""
    return ca.fmin(ca.fmax(t + 0.5, 0.0), 1.0)
