"""The tuning as one nonlinear program over all scenarios, solved by IPOPT.

    min  log value + WEIGHT |x - x_0|^2    subject to  limit_i(x) <= bound_i + relaxation_i slack_i

x are the logarithms of the gains, `value` the worst of the scenarios: the time, the RMS error of
the force over the slide, or the settling time. The slacks are zero, except in the elastic problem,
which minimizes their sum to find the limits that cannot be met.

Source of the elastic mode: Gill, Murray, Saunders, "SNOPT", SIAM Review 47(1), 2005, section 1.2.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from time import perf_counter

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core import ipopt
from ..core.arrays import Array
from ..core.ipopt import IterationCallback
from ..core.progress import Stage
from .feasible_sqp import ACTIVE, QuadraticModel, descend, descent_message
from .gains import NAMES, Demands, Gains
from .limits import WINDOW, Limit, Objective, objective_and_limits
from .shooting import SingleShooting

WEIGHT = 1e-5
"""Weight of the distance from the start, so that gains without influence stay where they are."""
ELASTIC = 1e3
"""Cost of a slack of 1 in the elastic problem, relative to that of the objective."""
DAMPING = 1.0
"""Hessian of the program for the least times. Limits and times are nearly linear in the logarithms
of the gains and the solution is a corner of limits: a plain proximal term takes 50 iterations,
quasi-Newton 100 and exact second derivatives over 100 (measured on the sphere)."""
TOLERANCE = 1e-3
"""Largest violation of a limit, in its scale, of an accepted solution."""
MAX_PREDICTED_DECREASE = 2e-3
"""Largest predicted decrease of the objective, relative to it, of a search that has converged:
twice MIN_GAIN."""
RELAXATION = 5e-3
"""Change of a limit, relative to its bound, for its one-sided multipliers."""
ONE_SIDED = 0.1
"""Difference of a limit's two one-sided multipliers, relative to the larger, from which on there is
a kink."""
OPTIONS: dict[str, object] = {"mu_strategy": "adaptive", "tol": 1e-5, "max_iter": 200}
"""Options of IPOPT."""
PATIENCE, INFEASIBLE_PATIENCE = 25, 50
"""Iterations without progress after which the search ends, from a point that meets the limits and
before one is found. Window maxima and interpolations are continuous, their slopes are not: the last
iterations may cross a kink back and forth without end."""
MIN_ITERATIONS = 40
"""Iterations that every search may take: the first ones lead away from the limits."""
MIN_GAIN = 1e-3
"""Least relative decrease of the merit that counts as progress."""
INFEASIBLE = 1e3
"""Merit from which on a point does not meet the limits; objectives are far below, s or relative."""
SOLVED = "solved"
"""Status of a search that IPOPT ended at a solution."""


@dataclass(frozen=True)
class TuningSolution:
    """A point where the solver ended."""

    gains: Gains
    value: float
    """Objective: s, or RMS error relative to the force asked for."""
    slacks: dict[str, float]
    """Violation of each limit that is not met, in Limit.relaxation."""
    multipliers: dict[str, float]
    """By limit: decrease of the objective per relaxation of the limit; by range of a gain: decrease
    for a range wider by the factor e."""
    one_sided: dict[str, tuple[float, float]]
    """Limits at a kink: decrease by relaxing and increase by tightening, as the multipliers."""
    predicted_decrease: float
    """Decrease of the objective that its slopes predict beyond this point, relative to it."""
    status: str
    """How the search ended."""
    iterations: int
    solve_seconds: float


class TuningProblem:
    """The program for some scenarios, `steps` steps of the closed loop long.

    start: the first gains; bounds (2, 8): lowest and highest gains; force: that the scene asks for,
    N.
    """

    def __init__(
        self,
        shootings: Sequence[SingleShooting],
        demands: Demands,
        objective: str,
        start: Gains,
        bounds: Array,
        steps: int,
        force: float,
    ) -> None:
        began = perf_counter()
        self.bounds, (self.low, self.high) = bounds, np.log(bounds)
        self.first = np.clip(np.log(np.array(start.values, dtype=float)), self.low, self.high)
        x, worst = ca.MX.sym("x", len(NAMES)), ca.MX.sym("worst")
        gains = Gains(*(ca.exp(x[k]) for k in range(len(NAMES))))
        objectives: list[Objective] = []
        limits: dict[str, list[Limit]] = {}
        for shooting in shootings:
            found = objective_and_limits(
                shooting, gains, demands, objective, steps + -steps % WINDOW, force
            )
            objectives.append(found[0])
            for limit in found[1]:
                limits.setdefault(limit.name, []).append(limit)
        self.limits = {name: found[0] for name, found in limits.items()}
        self.names, self.count = list(limits), len(objectives)
        values = [one.value for one in objectives]
        at_start = ca.Function("values", [x], [ca.vertcat(*values)])(self.first)
        self._unit = float(np.abs(at_start.full()).max())
        above = [ca.log(value / self._unit) - worst for value in values]
        self._peak_rows, peaks = _stack(above, limits, "peaks")
        self._step_rows, excess = _stack(above, limits, "excess")
        self._relaxation = np.array([one.relaxation / one.scale for one in self.limits.values()])

        slack, weight = ca.MX.sym("slack", len(self.names)), ca.MX.sym("weight", 2)
        factors = ca.DM(np.append(self._relaxation, 0.0)[self._peak_rows])
        slacks = ca.vertcat(slack, 0.0)[self._peak_rows.tolist()]  # -1, of objectives: the 0.0
        cost, point = worst + WEIGHT * ca.sumsqr(x - self.first), ca.vertcat(x, worst)
        nlp = {
            "x": ca.vertcat(point, slack),
            "p": weight,
            "f": weight[0] * cost + weight[1] * ca.sum1(slack),
            "g": peaks - factors * slacks,
        }
        derivatives = [ca.gradient(cost, point), excess, ca.jacobian(excess, point)]
        self._derivatives = ca.Function("derivatives", [point], derivatives)
        self._excess = ca.Function("excess", [point], [excess])
        curvatures = [one.curvature(x) for one in objectives]
        self._curvature = ca.Function(
            "curvature", [point], [sum(curvatures[1:], curvatures[0]) / self.count]
        )
        self.monitor = ConvergenceMonitor(nlp["x"].shape[0], nlp["g"].shape[0])
        self.solver = _solver(nlp, objective, self.monitor)
        self.build_seconds = perf_counter() - began

    def solve(self, start: Gains | None = None, elastic: bool = False) -> TuningSolution:
        """The solution from `start`; elastic: with the least sum of slacks."""
        began, count = perf_counter(), len(self.names)
        first = self.first if start is None else np.log(np.array(start.values, dtype=float))

        def violation(x: Array, g: Array) -> Array:
            slack = np.append(self._relaxation * x[len(NAMES) + 1 :], 0.0)
            return self._violation(g + slack[self._peak_rows], self._peak_rows)

        def merit(x: Array, g: Array) -> float:
            return float(violation(x, g).sum()) if elastic else self._merit(x, g, self._peak_rows)

        self.monitor.reset(merit)
        largest_slack = np.inf if elastic else 0.0
        self.solver(
            x0=np.concatenate([first, [0.0], np.full(count, 0.1 if elastic else 0.0)]),
            p=[1.0 / ELASTIC, 1.0] if elastic else [1.0, 0.0],
            lbx=np.concatenate([self.low, [-np.inf], np.zeros(count)]),
            ubx=np.concatenate([self.high, [np.inf], np.full(count, largest_slack)]),
            lbg=-np.inf,
            ubg=0.0,
        )
        self.monitor.check()
        stats, best = self.solver.stats(), self.monitor.best
        assert best is not None  # the start is an iterate
        feasible = self.monitor.least < INFEASIBLE or elastic
        status = termination_message(stats["return_status"], feasible, self.monitor.patience)
        return self._solution(best[: len(NAMES) + 1], status, int(stats["iter_count"]), began)

    def descend(self, solution: TuningSolution) -> TuningSolution:
        """Descent from a solution that meets the limits, without leaving them."""
        began = perf_counter()
        x = np.log([*solution.gains.values, solution.value / self._unit])
        x, count = descend(
            x, self._model, self._limits, lambda x, g: self._merit(x, g, self._step_rows)
        )
        return self._solution(x, descent_message(count), count, began)

    def _limits(self, x: Array) -> Array:
        """The limits at every step, at (log gains, worst) x (9,)."""
        return np.array(self._excess(x)).ravel()

    def _model(self, x: Array) -> QuadraticModel:
        """Objective and limits about (log gains, worst) x (9,)."""
        self.monitor.stage.step()
        gradient, limits, jacobian = (np.array(part) for part in self._derivatives(x))
        hessian = DAMPING * np.eye(len(x))
        hessian[: len(NAMES), : len(NAMES)] += np.array(self._curvature(x))
        return QuadraticModel(
            gradient=gradient.ravel(),
            limits=limits.ravel(),
            jacobian=jacobian,
            hessian=hessian,
            low=np.minimum(np.append(self.low, -np.inf) - x, 0.0),
            high=np.maximum(np.append(self.high, np.inf) - x, 0.0),
        )

    def _solution(self, x: Array, status: str, iterations: int, began: float) -> TuningSolution:
        """The solution at a point (log gains, worst) x (9,)."""
        g = self._limits(x)
        x = np.append(x[: len(NAMES)], x[len(NAMES)] + g[: self.count].max())
        value = float(np.exp(x[-1])) * self._unit
        model = self._model(x)
        violation = self._violation(model.limits, self._step_rows)
        multipliers, one_sided = self._multipliers(model, value)
        decrease = model.predicted_decrease()
        if decrease > MAX_PREDICTED_DECREASE:
            status += f", where slopes predict a further decrease of {100 * decrease:.2g} %"
        return TuningSolution(
            gains=Gains(*np.clip(np.exp(x[: len(NAMES)]), *self.bounds).tolist()),
            value=value,
            slacks={
                name: float(v / r)
                for name, v, r in zip(self.names, violation, self._relaxation, strict=True)
                if v > TOLERANCE
            },
            multipliers=multipliers,
            one_sided=one_sided,
            predicted_decrease=decrease,
            status=status,
            iterations=iterations,
            solve_seconds=perf_counter() - began,
        )

    def _multipliers(
        self, model: QuadraticModel, value: float
    ) -> tuple[dict[str, float], dict[str, tuple[float, float]]]:
        """Multipliers by limit and range, and those at a kink, in the objective's unit."""
        limits, ranges = model.multipliers()
        found: dict[str, float] = {}
        one_sided: dict[str, tuple[float, float]] = {}
        for k, (name, limit) in enumerate(self.limits.items()):
            rows, unit = self._step_rows == k, value * float(self._relaxation[k])
            if model.limits[rows].max() > -ACTIVE:
                found[name] = unit * float(limits[rows].sum())
                sides = model.one_sided_multipliers(rows, RELAXATION * limit.bound / limit.scale)
                if sides and abs(sides[1] - sides[0]) > ONE_SIDED * max(map(abs, sides)):
                    one_sided[name] = unit * sides[0], unit * sides[1]
        chosen = self.low < self.high  # the others are gains that were given
        for end in ranges.reshape(2, -1)[:, : len(NAMES)]:
            active = np.flatnonzero(chosen & (end > 0.0))
            found |= {f"range of {NAMES[k]}": value * float(end[k]) for k in active}
        return found, one_sided

    def _violation(self, g: Array, rows: NDArray[np.intp]) -> Array:
        """Violation of each limit, in its scale, at least 0; rows: the limit of each g."""
        violation, limits = np.zeros(len(self.names)), rows >= 0
        np.maximum.at(violation, rows[limits], g[limits])
        return violation

    def _merit(self, x: Array, g: Array, rows: NDArray[np.intp]) -> float:
        """The objective, or above INFEASIBLE where a limit is violated."""
        violation = float(self._violation(g, rows).max())
        value = float(np.exp(x[len(NAMES)] + g[: self.count].max())) * self._unit
        return value if violation < 0.5 * TOLERANCE else INFEASIBLE * (1.0 + violation)


def _stack(
    above: list[ca.MX], limits: Mapping[str, list[Limit]], what: str
) -> tuple[NDArray[np.intp], ca.MX]:
    """Rows of the objectives and of `what` of the limits, and the limit of each row (objectives:
    -1)."""
    parts = [(k, getattr(one, what)) for k, found in enumerate(limits.values()) for one in found]
    owner = [-1] * len(above) + [k for k, part in parts for _ in range(part.shape[0])]
    return np.array(owner, dtype=np.intp), ca.vertcat(*above, *(part for _, part in parts))


def _solver(nlp: dict[str, ca.MX], objective: str, monitor: ConvergenceMonitor) -> ca.Function:
    """IPOPT on the program, with DAMPING on the gains as the Hessian for the least times."""
    options, hessian = OPTIONS, None
    if objective == "force_error":  # the logarithm of an error that may vanish is curved
        options = OPTIONS | {"hessian_approximation": "limited-memory"}
    else:
        sizes = {name: nlp[name].shape[0] for name in ("x", "p", "g")}
        inputs = [ca.MX.sym(name, k) for name, k in (*sizes.items(), ("lam_f", 1))]
        x, p, lam_g, lam_f = inputs
        diagonal = ca.DM([DAMPING] * len(NAMES) + [0.0] * (sizes["x"] - len(NAMES)))
        hessian = ca.Function(
            "damping",
            [x, p, lam_f, lam_g],
            [ca.MX(ca.sparsify(ca.diag(diagonal))) * lam_f],
            ["x", "p", "lam_f", "lam_g"],
            ["triu_hess_gamma_x_x"],
        )
    # no warnings of evaluations: too far a step is unstable, and IPOPT takes a shorter one
    return ipopt.solver(
        "tune", nlp, options, hessian=hessian, callback=monitor, show_eval_warnings=False
    )


class ConvergenceMonitor(IterationCallback):
    """IPOPT's iteration callback for a program of `size` variables and `rows` constraints.

    It minimizes `merit(x, g)`: `best` is the best iterate x, `least` its merit.
    """

    def __init__(self, size: int, rows: int) -> None:
        super().__init__(size, rows, self._monitor)
        self.stage = Stage()
        """Whose steps are the iterations."""
        self.reset(lambda x, g: 0.0)

    def reset(self, merit: Callable[[Array, Array], float]) -> None:
        """Begin a search with a merit."""
        self.merit, self.idle, self.count = merit, 0, 0
        self.best: Array | None = None
        self.least = self.mark = np.inf

    def _monitor(self, x: Array, g: Array) -> bool:
        """Keep the iterate if it is the best, and return whether to stop."""
        merit = self.merit(x, g)
        if self.best is None or merit < self.least:
            self.best, self.least = x, merit
        self.count += 1
        self.stage.step()
        progress = merit < (1.0 - MIN_GAIN) * self.mark
        self.mark = merit if progress else self.mark
        self.idle = 0 if progress else self.idle + 1
        return (self.count > MIN_ITERATIONS and self.idle >= self.patience) or merit == 0.0

    @property
    def patience(self) -> int:
        """Iterations without progress after which the search ends."""
        return PATIENCE if self.mark < INFEASIBLE else INFEASIBLE_PATIENCE


def termination_message(status: str, feasible: bool, patience: int) -> str:
    """How IPOPT's search ended, by its return status."""
    if status == "Solve_Succeeded":
        return SOLVED
    reason = f"IPOPT returned {status}"
    if status == "User_Requested_Stop":  # by the monitor
        reason = f"no progress of {100 * MIN_GAIN:g} % in {patience} iterations"
    if feasible:
        return f"stopped at the best gains that meet the limits: {reason}"
    return f"stopped before any gains met the limits: {reason}"
