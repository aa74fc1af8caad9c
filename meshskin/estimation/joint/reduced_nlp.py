"""The reduced problem in the few global parameters as a CasADi NLP, solved by IPOPT.

Its functions are callbacks: each evaluation optimizes all taxels (variable_projection.py). The
parameters are whitened by their information at the start, so that tolerances are in standard
deviations and correlated parameters do not delay each other.
"""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca
import numpy as np

from ...core.arrays import Array
from ...core.ipopt import BufferCallback, IterationCallback, solver
from .variable_projection import ReducedProblem, SchurComplement, State

MAX_ITERATIONS = 30
"""Largest number of IPOPT's iterations; five are usual."""
NEWTON_TOLERANCE = 1e-8
"""Newton decrement, in units of the cost, at which an estimate is at its optimum: it is within
sqrt(2e-8) = 1.4e-4 standard deviations."""
MAX_EVALUATIONS = 90.0, 15.0
"""Evaluations of all taxels, and more for each global parameter, in which they must converge about
one linearization; one of a taxel counts 1 over their number, or LEAST_PART. 3 to 12 are usual. The
most where the model fits were 32 with a modulus 30 times its belief, and 103 with seven global
parameters, among them a body offset, in all linearizations; pressures of half or a quarter took 26
to 93, those 4 to 10 times too large more."""
LEAST_CURVATURE = 0.1
"""Least curvature along a step, relative to Gauss-Newton's: a step is no longer than ten of its."""


def minimize(
    problem: ReducedProblem,
    state: State,
    iterations: int,
    record: Callable[[State], None],
    tolerance: float = NEWTON_TOLERANCE,
) -> tuple[State, str]:
    """The state at the most likely global parameters, and IPOPT's status: "User_Requested_Stop"
    where it is within the tolerance; the evaluations where more than MAX_EVALUATIONS were asked.

    record: called with the state of every new lowest cost; tolerance: Newton decrement to reach.
    """
    if not len(state.s):
        return state, "no global parameters"
    evaluator = _Evaluator(problem, state, record, tolerance)
    x, size = ca.MX.sym("x", len(state.s)), len(state.s)
    factor, none, p = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", 0), ca.MX.sym("p", 0)
    cost = _function("cost", evaluator.cost, size, 1, 1)
    gradient = _function("gradient", evaluator.gradient, size, size, 1)
    hessian = _function("hessian", evaluator.hessian, size, size, size)
    run = solver(
        "joint",
        {"x": x, "p": p, "f": cost(x)},
        {
            "nlp_scaling_method": "none",
            "max_iter": iterations,
            # a gradient of 1e-5 is a step of 1e-5 standard deviations, and a decrement of 5e-11
            "tol": 0.1 * tolerance**0.5,
        },
        gradient=ca.Function("grad_f", [x, p], [cost(x), gradient(x)]),
        hessian=ca.Function("hess_lag", [x, p, factor, none], [ca.triu(factor * hessian(x))]),
        callback=(reached := IterationCallback(size, 0, lambda x, _: evaluator.ends(x))),
    )
    found = run(x0=np.linalg.solve(evaluator.scale, state.s))["x"].full().ravel()
    reached.check()
    evaluator.at(found)
    if evaluator.spent and not evaluator.near():
        spent = f"{problem.evaluations:.0f} evaluations of all taxels, limit {evaluator.most:.0f}"
        return evaluator.best, spent
    return evaluator.last, str(run.stats()["return_status"])


class _Evaluator:
    """The reduced problem at scaled parameters; keeps the last state, and the best as a start."""

    def __init__(
        self,
        problem: ReducedProblem,
        state: State,
        record: Callable[[State], None],
        tolerance: float,
    ) -> None:
        self.problem, self.record, self.tolerance = problem, record, tolerance
        self.last = self.best = state
        self.reduced = self.lowest = problem.reduce(state)
        self.scale = np.linalg.inv(np.linalg.cholesky(self.reduced.hessian)).T
        self.origin = self.reduced.cost
        self.step = np.zeros(len(state.s)), np.zeros(len(state.s))
        """The last step that lowered the cost, and the change of the gradient along it."""
        least, more = MAX_EVALUATIONS
        self.most = problem.evaluations + least + more * len(state.s)
        """Limit of the evaluations."""

    @property
    def spent(self) -> bool:
        """Whether the taxels were evaluated `most` times."""
        return self.problem.evaluations > self.most

    def near(self) -> bool:
        """Whether the last point is near enough to the optimum. Where contacts move, cost and
        gradient agree to a thousandth only, and IPOPT's own tolerance may be out of reach."""
        return self.reduced.decrement <= self.tolerance

    def ends(self, x: Array) -> bool:
        """Whether the search ends at x."""
        self.at(x)
        return self.near() or self.spent

    def at(self, x: Array) -> SchurComplement:
        """At x; where the last evaluation was if they are spent, so that IPOPT finds no step."""
        s = self.scale @ x
        if not np.array_equal(s, self.last.s) and not self.spent:
            self.last = self.problem.solved_at(self.best, s, self.lowest.decrement)
            self.reduced = self.problem.reduce(self.last)
            if self.reduced.cost < self.lowest.cost:
                slope = self.reduced.gradient - self.lowest.gradient
                self.step = self.last.s - self.best.s, slope
                self.best, self.lowest = self.last, self.reduced
                self.record(self.last)
        return self.reduced

    def cost(self, x: Array) -> float:
        return self.at(x).cost - self.origin

    def gradient(self, x: Array) -> Array:
        return self.scale.T @ self.at(x).gradient

    def hessian(self, x: Array) -> Array:
        """Gauss-Newton's with the curvature along the last step, by a BFGS update. Where the model
        misfits, the cost has a third of that curvature or less, and steps without it are too short.
        """
        hessian, (step, slope) = self.at(x).hessian, self.step
        expected = hessian @ step
        along = float(step @ expected)
        if self.reduced is self.lowest and along > 0.0:
            slope = slope + max(LEAST_CURVATURE - float(slope @ step) / along, 0.0) * expected
            hessian = hessian - np.outer(expected, expected) / along
            hessian = hessian + np.outer(slope, slope) / (slope @ step)
        return self.scale.T @ hessian @ self.scale


def _function(
    name: str, evaluate: Callable[[Array], Array | float], size: int, rows: int, columns: int
) -> BufferCallback:
    """A symmetric or column-shaped answer (rows, columns) of the evaluator to `size` unknowns."""

    def write(inputs: list[Array], outputs: list[Array | None]) -> None:
        if outputs[0] is not None:
            outputs[0][:] = np.ravel(evaluate(inputs[0]))

    return BufferCallback(
        name, [ca.Sparsity.dense(size)], [ca.Sparsity.dense(rows, columns)], write
    )
