"""IPOPT through CasADi: solvers with common options, and CasADi functions of NumPy arrays.

cyipopt was weighed: it has neither CasADi's derivatives nor its compiled functions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np

from .arrays import Array


def solver(
    name: str,
    nlp: Mapping[str, ca.MX],
    options: Mapping[str, object],
    *,
    gradient: ca.Function | None = None,
    hessian: ca.Function | None = None,
    callback: IterationCallback | None = None,
    show_eval_warnings: bool = True,
) -> ca.Function:
    """IPOPT, without output, on the program `nlp` with the unknowns x.

    options: of IPOPT. gradient: (f, df/dx) of (x, p); with it, CasADi differentiates nothing and
    evaluates nothing after the last iteration. hessian: upper triangle of the Lagrangian's Hessian
    of (x, p, lam_f, lam_g). By default both follow by automatic differentiation.
    """
    chosen: dict[str, Any] = {
        "print_time": False,
        "show_eval_warnings": show_eval_warnings,
        "ipopt": {"print_level": 0, "sb": "yes", **options},
    }
    if gradient is not None:
        unused = dict.fromkeys(("calc_f", "calc_g", "calc_lam_x", "calc_lam_p"), False)
        chosen |= {"grad_f": gradient, "no_nlp_grad": True, **unused}
    if hessian is not None:
        chosen["hess_lag"] = hessian
    if callback is not None:
        chosen["iteration_callback"] = callback
    return ca.nlpsol(name, "ipopt", dict(nlp), chosen)


class BufferCallback(ca.Callback):
    """A CasADi function that reads and writes CasADi's memory through NumPy arrays, not copied.

    `evaluate` gets the nonzeros of every input, and an array for the nonzeros of every output, None
    for an output that is not asked for. CasADi does not own callbacks: the caller keeps them.
    """

    def __init__(
        self,
        name: str,
        inputs: Sequence[ca.Sparsity],
        outputs: Sequence[ca.Sparsity],
        evaluate: Callable[[list[Array], list[Array | None]], None],
    ) -> None:
        ca.Callback.__init__(self)
        self._inputs, self._outputs, self._evaluate = inputs, outputs, evaluate
        self.construct(name, {})

    def get_n_in(self) -> int:
        return len(self._inputs)

    def get_n_out(self) -> int:
        return len(self._outputs)

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return self._inputs[i]

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        return self._outputs[i]

    def has_eval_buffer(self) -> bool:
        return True

    def eval_buffer(self, inputs: Any, outputs: Any) -> int:
        given = [np.frombuffer(value) for value in inputs]
        self._evaluate(given, [None if out is None else np.frombuffer(out) for out in outputs])
        return 0


class BufferedFunction:
    """A CasADi function called on NumPy arrays, not copied, with its memory kept between calls."""

    def __init__(self, function: ca.Function) -> None:
        self._function = function
        self._buffer: Any
        self._buffer, self._evaluate = function.buffer()

    def __call__(self, *inputs: Array) -> list[Array]:
        """Nonzeros of every output; the last inputs may be left out: zero."""
        view: Any = memoryview
        for k, value in enumerate(inputs):
            self._buffer.set_arg(k, view(value))
        sizes = [self._function.nnz_out(k) for k in range(self._function.n_out())]
        outputs = [np.zeros(size) for size in sizes]
        for k, value in enumerate(outputs):
            self._buffer.set_res(k, view(value))
        self._evaluate()
        return outputs

    def stats(self) -> dict[str, Any]:
        """Statistics of the last call."""
        return dict(self._buffer.stats())


class IterationCallback(ca.Callback):
    """Called after each iteration of IPOPT on `size` unknowns and `rows` constraints.

    `iterate(x, g)` gets the unknowns and the constraints, and may return True to stop. What it
    raises stops IPOPT, too, and is raised again by `check`: CasADi would drop it.
    """

    def __init__(
        self, size: int, rows: int, iterate: Callable[[Array, Array], bool | None]
    ) -> None:
        ca.Callback.__init__(self)
        self._iterate, self._raised = iterate, list[BaseException]()
        self._sizes = {"x": size, "lam_x": size, "g": rows, "lam_g": rows, "f": 1}
        self.construct("iteration", {})

    def get_n_in(self) -> int:
        return int(ca.nlpsol_n_out())

    def get_n_out(self) -> int:
        return 1

    def get_name_in(self, i: int) -> str:
        return str(ca.nlpsol_out(i))

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        count = self._sizes.get(ca.nlpsol_out(i), 0)
        return ca.Sparsity.dense(count, 1 if count else 0)

    def eval(self, arg: Sequence[ca.DM]) -> list[int]:
        values = {ca.nlpsol_out(k): value.full().ravel() for k, value in enumerate(arg)}
        try:
            return [int(bool(self._iterate(values["x"], values["g"])))]
        except BaseException as error:
            self._raised.append(error)
            return [1]

    def check(self) -> None:
        """Raise what `iterate` raised in the run that has ended."""
        if self._raised:
            raise self._raised.pop()
