"""The problem in the few shared unknowns as a CasADi NLP, solved by IPOPT.

Its functions are callbacks: each evaluation settles all taxels (eliminate.py). Unknowns are scaled
by their information at the start, so that tolerances are in standard deviations.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from ...core.se3 import Array
from .variable_projection import ReducedProblem, SchurComplement, State

IPOPT: dict[str, object] = {
    "nlp_scaling_method": "none",
    "print_level": 0,
    "sb": "yes",
}
MAX_ITERATIONS = 30
"""Most iterations of IPOPT."""
NEWTON_TOLERANCE = 1e-8
"""Newton decrement, in units of the cost, at which an estimate is at its optimum: a move of some
1e-4 standard deviations."""


def minimize(
    problem: ReducedProblem,
    state: State,
    iterations: int,
    watch: Callable[[State], None],
    tolerance: float = NEWTON_TOLERANCE,
) -> tuple[State, str]:
    """The state at the most likely shared unknowns, and IPOPT's status.

    `watch` sees the state of every new lowest cost; tolerance: Newton decrement to be reached.
    """
    if not len(state.s):
        return state, "nothing shared"
    evaluator = _Evaluator(problem, state, watch)
    x, size = ca.MX.sym("x", len(state.s)), len(state.s)
    factor, none, p = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", 0), ca.MX.sym("p", 0)
    cost, slope, curvature = (
        _Function(name, evaluator, size, shape)
        for name, shape in (("cost", (1, 1)), ("gradient", (size, 1)), ("hessian", (size, size)))
    )
    options: dict[str, Any] = {
        "grad_f": ca.Function("grad_f", [x, p], [cost(x), slope(x)]),
        "hess_lag": ca.Function("hess_lag", [x, p, factor, none], [ca.triu(factor * curvature(x))]),
        "no_nlp_grad": True,
        "calc_f": False,
        "calc_g": False,
        "calc_lam_x": False,
        "calc_lam_p": False,
        "print_time": False,
        # a gradient of 1e-5 is a step of 1e-5 standard deviations, and a decrement of 5e-11
        "ipopt": IPOPT | {"max_iter": iterations, "tol": 0.1 * tolerance**0.5},
    }
    solver = ca.nlpsol("joint", "ipopt", {"x": x, "p": p, "f": cost(x)}, options)
    found = solver(x0=state.s / evaluator.scale)["x"].full().ravel()
    evaluator.at(found)
    return evaluator.last, str(solver.stats()["return_status"])


class _Evaluator:
    """The reduced problem at scaled unknowns; keeps its last answer, and the best as a start."""

    def __init__(
        self, problem: ReducedProblem, state: State, watch: Callable[[State], None]
    ) -> None:
        self.problem, self.watch = problem, watch
        self.last = self.best = state
        self.reduced = self.lowest = problem.reduce(state)
        self.scale = 1 / np.sqrt(np.diag(self.reduced.hessian))
        self.origin = self.reduced.cost

    def at(self, x: Array) -> SchurComplement:
        s = self.scale * x
        if not np.array_equal(s, self.last.s):
            self.last = self.problem.moved(self.best, s)
            self.reduced = self.problem.reduce(self.last)
            if self.reduced.cost < self.lowest.cost:
                self.best, self.lowest = self.last, self.reduced
                self.watch(self.last)
        return self.reduced

    def cost(self, x: Array) -> Array:
        return np.array([[self.at(x).cost - self.origin]])

    def gradient(self, x: Array) -> Array:
        return (self.scale * self.at(x).gradient)[:, None]

    def hessian(self, x: Array) -> Array:
        return self.scale[:, None] * self.at(x).hessian * self.scale


class _Function(ca.Callback):
    """One of the evaluator's answers as a CasADi function."""

    def __init__(self, name: str, evaluator: _Evaluator, size: int, shape: tuple[int, int]) -> None:
        ca.Callback.__init__(self)
        self.answer, self.size, self.shape = getattr(evaluator, name), size, shape
        self.construct(name, {})

    def get_n_in(self) -> int:
        return 1

    def get_n_out(self) -> int:
        return 1

    def get_sparsity_in(self, i: int) -> Any:
        return ca.Sparsity.dense(self.size)

    def get_sparsity_out(self, i: int) -> Any:
        return ca.Sparsity.dense(*self.shape)

    def eval(self, arg: Any) -> list[Any]:
        return [ca.DM(self.answer(arg[0].full().ravel()))]
