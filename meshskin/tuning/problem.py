"""The tuning as one nonlinear program over all scenarios, solved by IPOPT.

    min  log value + WEIGHT |x - x_0|^2      subject to  limit_i(x) <= bound_i + whole_i slack_i

x are the logarithms of the gains, `value` the worst of the scenarios: the time, or the RMS error of
the force over the slide, or the settling time. The slacks are zero, but in the elastic problem,
which minimises their sum to find out what stands in the way.

Source of the elastic mode: Gill, Murray, Saunders, "SNOPT", SIAM Review 47(1), 2005, section 1.2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import casadi as ca
import numpy as np
from scipy.optimize import nnls

from ..se3 import Array
from .descent import descend
from .gains import NAMES, Demands, Gains
from .limits import WINDOW, Aim, Judge, Limit
from .shooting import Shot
from .watch import BROKEN, Watch

WEIGHT = 1e-5
"""Pull towards the start, that gains which matter to nothing rest."""
ELASTIC = 1e3
"""Cost of a slack of 1 in the elastic problem, over that of the objective."""
DAMPING = 1.0
"""Curvature given to the program for the least times: limits and times are nearly linear in the
logarithms of the gains, the solution is a corner of limits, and a plain proximal term gets there in
fewer steps than quasi-Newton or exact second derivatives (measured: 50, 100 and over 100)."""
TOLERANCE = 1e-3
"""Largest violation of a limit, in its scale, of a solution that is taken."""
TOUCHED = 2e-3
"""Distance from a limit, in its scale, or from the end of a range, below which it is touched."""
FLAT = 1e-2
"""Change of a limit, in its scale, by gains e times as large, below which none holds it."""
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
class Solution:
    """Where the solver ended."""

    gains: Gains
    value: float
    """Objective: s, or part of the reference force."""
    slacks: dict[str, float]
    """How far each limit is broken, in its whole; empty where none is."""
    multipliers: dict[str, float]
    """By limit: what a relaxation by its whole gains in the objective; by gain: what its bound
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
        self.shots = shots
        self.span, (self.low, self.high) = span, np.log(span)
        self.first = np.clip(np.log(np.array(start.values, dtype=float)), self.low, self.high)
        x = ca.MX.sym("x", len(NAMES))
        gains = Gains(*(ca.exp(x[k]) for k in range(len(NAMES))))
        judge = Judge(demands, objective, steps + -steps % WINDOW, target)
        limits: dict[str, list[Limit]] = {}
        aims: list[Aim] = []
        for shot in shots:
            aim, found = judge(shot, gains)
            aims.append(aim)
            for limit in found:
                limits.setdefault(limit.name, []).append(limit)
        self.limits = {name: found[0] for name, found in limits.items()}
        self.names = list(limits)
        slack, worst = ca.MX.sym("slack", len(self.names)), ca.MX.sym("worst")
        weight = ca.MX.sym("weight", 2)
        values = [aim.value for aim in aims]
        self._unit = self._first_value(values, x)
        g = [ca.log(value / self._unit) - worst for value in values]
        rows = [-1] * len(values)
        for k, found in enumerate(limits.values()):
            for one in found:
                g.append((one.quantity - one.bound - one.whole * slack[k]) / one.scale)
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
        self._limits = ca.Function("limits", [nlp["x"], nlp["p"]], [nlp["g"]])
        self.bent = objective == "force_error"
        bends = [aim.curvature(x) for aim in aims]
        self._bends = ca.Function("bends", [nlp["x"]], [sum(bends[1:], bends[0]) / len(bends)])
        self.watch = Watch(nlp["x"].shape[0], nlp["g"].shape[0])
        made: dict[str, Any] = {"iteration_callback": self.watch}
        if objective != "force_error":
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
        count = int(stats["iter_count"])
        return self._solution(best.x, best.g, stats["return_status"], count, began)

    def descend(self, solution: Solution) -> Solution:
        """Downhill from a solution that meets the limits, never leaving them."""
        began = perf_counter()
        many = len(self.names)
        x = np.concatenate([np.log(solution.gains.values), np.zeros(1 + many)])
        x[len(NAMES)] = np.log(solution.value / self._unit)

        def model(x: Array) -> tuple[Array, Array, Array]:
            slope, slopes = (np.array(s) for s in self._slopes(x, [1.0, 0.0]))
            return slope.ravel(), slopes, self._bent(x)

        x, g, count = descend(
            x,
            lambda x: np.array(self._limits(x, [1.0, 0.0])).ravel(),
            model,
            self._merit,
            np.concatenate([self.low, [-np.inf], np.zeros(many)]),
            np.concatenate([self.high, [np.inf], np.zeros(many)]),
        )
        return self._solution(x, g, solution.status, count, began)

    def _bent(self, x: Array) -> Array:
        """Curvature of the objective at an iterate, with DAMPING."""
        bent = DAMPING * np.eye(len(x))
        bent[: len(NAMES), : len(NAMES)] += np.array(self._bends(x))
        return bent

    def _solution(self, x: Array, g: Array, status: str, iterations: int, began: float) -> Solution:
        """What an iterate (x, g) says."""
        over, pulls = self._broken(x, g), self._multipliers(x, g)
        value = self._value(x, g) * self._unit
        return Solution(
            gains=Gains(*np.clip(np.exp(x[: len(NAMES)]), *self.span).tolist()),
            value=value,
            slacks={
                n: float(v * self.limits[n].scale / self.limits[n].whole)
                for n, v in zip(self.names, over, strict=True)
                if v > TOLERANCE
            },
            multipliers={n: float(v * value) for n, v in pulls.items()},
            status=status,
            iterations=iterations,
            seconds=perf_counter() - began,
        )

    def _multipliers(self, x: Array, g: Array) -> dict[str, float]:
        """Multipliers of the limits and ranges that an iterate touches, in the program's units.

        By non-negative least squares on the stationarity of the Lagrangian, so that they depend
        neither on the solver's barrier nor on where it stopped: the residual is measured by the
        step that it calls for, that a slope which a hair's breadth would level counts for little.
        """
        size = len(NAMES)
        cost, slopes = (np.array(s) for s in self._slopes(x, [1.0, 0.0]))
        worst = len(self.shots)
        above = g.copy()
        above[:worst] -= g[:worst].max()  # the worst scenario counts, wherever its bound was left
        moved = np.abs(slopes[:, :size]).max(axis=1) > FLAT
        touched = np.flatnonzero((above > -TOUCHED) & moved)
        ends = np.concatenate([self.low - x[:size], x[:size] - self.high]) > -TOUCHED
        walls = np.concatenate([-np.eye(size), np.eye(size)])[ends]
        walls = np.concatenate([walls, np.zeros((len(walls), 1))], axis=1)
        columns = np.concatenate([slopes[touched, : size + 1], walls]).T
        root = np.linalg.cholesky(self._bent(x)[: size + 1, : size + 1])
        pull = nnls(*(np.linalg.solve(root, b) for b in (columns, -cost.ravel()[: size + 1])))[0]
        names = [self.names[k] if k >= 0 else "" for k in self._rows[touched]]
        names += [f"range of {name}" for name in np.array([*NAMES, *NAMES])[ends]]
        found: dict[str, float] = {}
        for name, value in zip(names, pull, strict=True):
            limit = self.limits.get(name)
            told = limit.whole / limit.scale if limit else 1.0
            found[name] = found.get(name, 0.0) + told * float(value)
        found.pop("", None)  # the scenarios' shares of the objective
        for name in np.array(NAMES)[self.low == self.high]:  # a gain that was given
            found.pop(f"range of {name}", None)
        return found

    def _value(self, x: Array, g: Array) -> float:
        """The objective, in its unit, at an iterate: the worst of the scenarios."""
        return float(np.exp(x[len(NAMES)] + g[: len(self.shots)].max()))

    def _broken(self, x: Array, g: Array) -> Array:
        """How far each limit is broken at an iterate, in its scale; at least 0."""
        over, rows = np.zeros(len(self.names)), self._rows[self._some]
        own = np.array([limit.whole / limit.scale for limit in self.limits.values()])
        np.maximum.at(over, rows, g[self._some] + (own * x[len(NAMES) + 1 :])[rows])
        return over

    def _merit(self, x: Array, g: Array) -> float:
        """Of a point on the way to the solution: any that meets the limits is better than none."""
        over = float(self._broken(x, g).max())
        return self._value(x, g) if over < 0.5 * TOLERANCE else BROKEN * (1.0 + over)

    def _first_value(self, values: Sequence[ca.MX], x: ca.MX) -> float:
        """The objective at the start: its unit in the program."""
        at = ca.Function("values", [x], [ca.vertcat(*values)])(self.first)
        return float(np.abs(at.full()).max())


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
