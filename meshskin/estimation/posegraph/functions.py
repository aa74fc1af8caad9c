"""CasADi functions of NumPy arrays, in both directions without a copy."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca
import numpy as np

from ...core.se3 import Array


class Function(ca.Callback):
    """A function that reads and writes CasADi's memory as it is: arrays of nonzeros, None unasked.

    From CasADi's matrices to Python's arrays and back would cost more than most evaluations.
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


class Call:
    """A CasADi function of arrays that are handed over as they are, with its memory kept.

    From Python's arrays to CasADi's matrices and back would cost more than most evaluations.
    """

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


class Recorder(ca.Callback):
    """Keeps x after every iteration of IPOPT."""

    def __init__(self, size: int) -> None:
        ca.Callback.__init__(self)
        self.size, self.path = size, list[Array]()
        self.construct("recorder", {})

    def get_n_in(self) -> int:
        return int(ca.nlpsol_n_out())

    def get_n_out(self) -> int:
        return 1

    def get_name_in(self, i: int) -> str:
        return str(ca.nlpsol_out(i))

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        name = ca.nlpsol_out(i)
        if name in ("x", "lam_x"):
            return ca.Sparsity.dense(self.size)
        return ca.Sparsity.dense(1) if name == "f" else ca.Sparsity(0, 0)

    def eval(self, arguments: Sequence[ca.DM]) -> list[ca.DM]:
        self.path.append(arguments[0].full()[:, 0])
        return [ca.DM(0)]
