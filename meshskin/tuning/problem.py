"""The tuning as one nonlinear program over all scenarios, solved by IPOPT.

    min  log value + WEIGHT |x - x_0|^2      subject to  limit_i(x) <= bound_i + whole_i slack_i

x are the logarithms of the gains, `value` the worst of the scenarios: the time, or the RMS error of
the force over the slide, or the settling time. The slacks are zero, but in the elastic problem,
which minimises their sum to find out what stands in the way.

Source of the elastic mode: Gill, Murray, Saunders, "SNOPT", SIAM Review 47(1), 2005, section 1.2.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from time import perf_counter

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core import ipopt
from ..core.se3 import Array
from .convergence import BROKEN, ConvergenceMonitor, ended
from .descent import Model, descend, descended
from .gains import NAMES, Demands, Gains
from .limits import WINDOW, Aim, Judge, Limit
from .multipliers import MOVED, TOUCHED, apart, promised, pulls, sided
from .shooting import ShootingInterval

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
LEFT = 2e-3
"""Largest promise of the slopes, part of the objective, of a search that is at its end."""
ONE_SIDED = 0.1
"""Difference of a limit's two prices, part of the larger, from which on it has no one price."""
OPTIONS: dict[str, object] = {"mu_strategy": "adaptive", "tol": 1e-5, "max_iter": 200}
"""Of IPOPT."""


@dataclass(frozen=True)
class TuningSolution:
    """Where the solver ended."""

    gains: Gains
    value: float
    """Objective: s, or part of the reference force."""
    slacks: dict[str, float]
    """How far each limit is broken, in its whole; empty where none is."""
    multipliers: dict[str, float]
    """By limit: what a relaxation by its whole gains in the objective; by gain: what its bound
    holds back, for a change by the factor e."""
    one_sided: dict[str, tuple[float, float]]
    """Limits whose relaxing gains less than their tightening costs: the two, as the multipliers."""
    left: float
    """What the slopes promise beyond, part of the objective."""
    status: str
    """How the search ended, in words."""
    iterations: int
    seconds: float


class TuningProblem:
    """The program for some shots (scenarios), `steps` steps of the closed loop long."""

    def __init__(
        self,
        shots: Sequence[ShootingInterval],
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
        aims, limits = _judged(judge, shots, gains)
        self.limits = {name: found[0] for name, found in limits.items()}
        self.names = list(limits)
        slack, worst = ca.MX.sym("slack", len(self.names)), ca.MX.sym("worst")
        weight = ca.MX.sym("weight", 2)
        values = [aim.value for aim in aims]
        self._unit = self._first_value(values, x)
        above = [ca.log(value / self._unit) - worst for value in values]
        self._rows, peaks = _listed(above, limits, "peaks")
        self._fine, excess = _listed(above, limits, "excess")
        self._whole = np.array([limit.whole / limit.scale for limit in self.limits.values()])
        own = ca.DM(np.append(self._whole, 0.0)[self._rows])  # -1, of the objectives: the last
        slacked = ca.vertcat(slack, 0.0)[self._rows.tolist()]
        cost = worst + WEIGHT * ca.sumsqr(x - self.first)
        nlp = {
            "x": ca.vertcat(x, worst, slack),
            "p": weight,
            "f": weight[0] * cost + weight[1] * ca.sum1(slack),
            "g": peaks - own * slacked,
        }
        self.nlp, base = nlp, ca.vertcat(x, worst)
        slopes = [ca.gradient(cost, base), excess, ca.jacobian(excess, base)]
        self._slopes = ca.Function("slopes", [base], slopes)
        self._limits = ca.Function("limits", [base], [excess])
        bends = [aim.curvature(x) for aim in aims]
        self._bends = ca.Function("bends", [base], [sum(bends[1:], bends[0]) / len(bends)])
        self.watch = ConvergenceMonitor(nlp["x"].shape[0], nlp["g"].shape[0])
        self.solver = _solver(nlp, objective, self.watch)
        self.build_seconds = perf_counter() - began

    def solve(self, start: Gains | None = None, elastic: bool = False) -> TuningSolution:
        """The solution from `start`; elastic: with slacks, at the least sum of them."""
        began = perf_counter()
        many = len(self.names)
        first = self.first if start is None else np.log(np.array(start.values, dtype=float))
        guess = np.concatenate([first, [0.0], np.full(many, 0.1 if elastic else 0.0)])

        def broken(x: Array, g: Array) -> Array:
            slack = np.append(self._whole * x[len(NAMES) + 1 :], 0.0)
            return self._broken(g + slack[self._rows], self._rows)

        def merit(x: Array, g: Array) -> float:
            return float(broken(x, g).sum()) if elastic else self._merit(x, g, self._rows)

        self.watch.begin(merit)
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
        status = ended(stats["return_status"], best.merit < BROKEN or elastic, self.watch.patience)
        return self._solution(best.x[: len(guess) - many], status, int(stats["iter_count"]), began)

    def descend(self, solution: TuningSolution) -> TuningSolution:
        """Downhill from a solution that meets the limits, never leaving them."""
        began = perf_counter()
        x = np.log([*solution.gains.values, solution.value / self._unit])
        x, count = descend(
            x, self._model, self._limited, lambda x, g: self._merit(x, g, self._fine)
        )
        return self._solution(x, descended(count), count, began)

    def _limited(self, x: Array) -> Array:
        """The limits at every step, at (gains, worst) `x`."""
        return np.array(self._limits(x)).ravel()

    def _model(self, x: Array) -> Model:
        """Objective and limits about (gains, worst) `x`."""
        slope, limits, slopes = (np.array(part) for part in self._slopes(x))
        bent = DAMPING * np.eye(len(x))
        bent[: len(NAMES), : len(NAMES)] += np.array(self._bends(x))
        low, high = np.append(self.low, -np.inf), np.append(self.high, np.inf)
        return Model(
            slope.ravel(), limits.ravel(), slopes, bent,
            np.minimum(low - x, 0.0), np.maximum(high - x, 0.0),
        )  # fmt: skip

    def _solution(self, x: Array, status: str, iterations: int, began: float) -> TuningSolution:
        """What a point (gains, worst) says."""
        g = self._limited(x)
        x = np.append(x[: len(NAMES)], x[len(NAMES)] + g[: len(self.shots)].max())
        value = float(np.exp(x[-1])) * self._unit
        model = self._model(x)
        over = self._broken(model.limits, self._fine)
        multipliers, one_sided = self._prices(model, value)
        left = promised(model)
        more = f", where slopes still promise {100 * left:.2g} %" if left > LEFT else ""
        return TuningSolution(
            gains=Gains(*np.clip(np.exp(x[: len(NAMES)]), *self.span).tolist()),
            value=value,
            slacks={
                n: float(v / self._whole[k])
                for k, (n, v) in enumerate(zip(self.names, over, strict=True))
                if v > TOLERANCE
            },
            multipliers=multipliers,
            one_sided=one_sided,
            left=left,
            status=status + more,
            iterations=iterations,
            seconds=perf_counter() - began,
        )

    def _prices(
        self, model: Model, value: float
    ) -> tuple[dict[str, float], dict[str, tuple[float, float]]]:
        """Multipliers by limit and range, and limits with two prices, in the objective's unit."""
        limits, ranges = pulls(model)
        found: dict[str, float] = {}
        sides: dict[str, tuple[float, float]] = {}
        for k, (name, limit) in enumerate(self.limits.items()):
            rows, told = self._fine == k, value * float(self._whole[k])
            if model.limits[rows].max() > -TOUCHED:
                found[name] = told * float(limits[rows].sum())
                both = sided(model, rows, MOVED * limit.bound / limit.scale)
                if both:
                    sides[name] = float(told * both[0]), float(told * both[1])
        held = self.low < self.high  # the others are gains that were given
        for end in ranges.reshape(2, -1)[:, : len(NAMES)]:
            pulled = np.flatnonzero(held & (end > 0.0))
            found |= {f"range of {NAMES[k]}": value * float(end[k]) for k in pulled}
        return found, apart(sides, ONE_SIDED)

    def _broken(self, g: Array, rows: NDArray[np.intp]) -> Array:
        """How far each limit is broken where `rows` are `g`, in its scale; at least 0."""
        over, some = np.zeros(len(self.names)), rows >= 0
        np.maximum.at(over, rows[some], g[some])
        return over

    def _merit(self, x: Array, g: Array, rows: NDArray[np.intp]) -> float:
        """Of a point on the way to the solution: any that meets the limits is better than none."""
        over = float(self._broken(g, rows).max())
        value = float(np.exp(x[len(NAMES)] + g[: len(self.shots)].max())) * self._unit
        return value if over < 0.5 * TOLERANCE else BROKEN * (1.0 + over)

    def _first_value(self, values: Sequence[ca.MX], x: ca.MX) -> float:
        """The objective at the start: its unit in the program."""
        at = ca.Function("values", [x], [ca.vertcat(*values)])(self.first)
        return float(np.abs(at.full()).max())


def _judged(
    judge: Judge, shots: Sequence[ShootingInterval], gains: Gains
) -> tuple[list[Aim], dict[str, list[Limit]]]:
    """The aim of each shot, and the limits of all of them by name."""
    aims: list[Aim] = []
    limits: dict[str, list[Limit]] = {}
    for shot in shots:
        aim, found = judge(shot, gains)
        aims.append(aim)
        for limit in found:
            limits.setdefault(limit.name, []).append(limit)
    return aims, limits


def _solver(nlp: dict[str, ca.MX], objective: str, watch: ConvergenceMonitor) -> ca.Function:
    """IPOPT on the program, under watch."""
    options, hessian = OPTIONS, None
    if objective != "force_error":
        hessian = _damping(nlp)
    else:  # the logarithm of an error that may vanish is bent: it needs its curvature
        options = OPTIONS | {"hessian_approximation": "limited-memory"}
    # no warnings of evaluations: a step too far is unstable, and IPOPT takes a shorter one
    return ipopt.solver(
        "tune", nlp, options, hessian=hessian, callback=watch, show_eval_warnings=False
    )


def _listed(
    above: list[ca.MX], limits: Mapping[str, list[Limit]], what: str
) -> tuple[NDArray[np.intp], ca.MX]:
    """Which limit (-1: none) each row is of, and the rows: the objectives, `what` of the limits."""
    parts = [(k, getattr(one, what)) for k, found in enumerate(limits.values()) for one in found]
    owner = [-1] * len(above) + [k for k, part in parts for _ in range(part.shape[0])]
    return np.array(owner, dtype=np.intp), ca.vertcat(*above, *(part for _, part in parts))


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
