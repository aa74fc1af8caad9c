"""One step of the closed loop as a CasADi function, and blocks of steps in one call.

The surface enters as the patch of one face (a parameter) and the foot point of the indenter's
center on it (a state), so that a step costs the same on any mesh.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from ..core.arrays import Array
from ..core.content_cache import cached_by_content
from . import integrators, quasi_static
from .closed_loop_model import REFERENCE, ClosedLoopModel, flat_anchor


@cached_by_content
def step(loop: ClosedLoopModel) -> ca.Function:
    """The step (state, reference, anchor, parameters) -> (next state, output).

    state (2 n + memory + 2,): q, qdot, delayed measurements, foot point (u, v); without an arm see
    quasi_static. reference (18,): pose and twist of the body along the path, world frame. anchor
    (69,): patch of the foot point's face and map from the previous face. parameters (9,). output:
    see ClosedLoopModel.outputs.
    """
    return quasi_static.step(loop) if loop.mode == "quasi_static" else integrators.step(loop)


def bind(
    function: ca.Function, inputs: tuple[Array, ...], results: tuple[Array, ...]
) -> tuple[Any, Callable[[], None]]:
    """A buffer and a call of a CasADi function that reads `inputs` and fills `results`.

    The call has no Python overhead. The arrays must stay the same objects, and the buffer must live
    as long as the call.
    """
    made: Any = function.buffer()  # CasADi's type stub asks for sizes that it does not take
    buffer, call = made
    array: Any
    for k, array in enumerate(inputs):
        buffer.set_arg(k, memoryview(array))
    for k, array in enumerate(results):
        buffer.set_res(k, memoryview(array))
    return buffer, call


class StepBlock:
    """`length` consecutive steps in one call.

    `state`, `references`, `anchors` and `parameters` are read; `states` (after each step) and
    `outputs` (before it) are filled. They must stay the same objects.
    """

    def __init__(
        self, loop: ClosedLoopModel, length: int, function: ca.Function | None = None
    ) -> None:
        function = step(loop) if function is None else function
        self.length = length
        self.state = np.zeros(function.size1_in(0))
        self.references = np.zeros((length, REFERENCE))
        self.anchors = np.tile(flat_anchor(np.zeros((21, 3))), (length, 1))
        self.parameters = np.array(loop.parameters.values, dtype=float)
        self.states = np.zeros((length, function.size1_out(0)))
        self.outputs = np.zeros((length, function.size1_out(1)))
        state, references, anchors, parameters = (
            ca.MX.sym(name, *shape)
            for name, shape in (
                ("state", self.state.shape),
                ("references", self.references.T.shape),
                ("anchors", self.anchors.T.shape),
                ("parameters", self.parameters.shape),
            )
        )
        chain = function.mapaccum("steps", length)
        after, before = chain(state, references, anchors, ca.repmat(parameters, 1, length))
        block = ca.Function("block", [state, references, anchors, parameters], [after, before])
        self._buffer, self._call = bind(
            block,
            (self.state, self.references, self.anchors, self.parameters),
            (self.states, self.outputs),
        )

    def run(self) -> None:
        """Run the block."""
        self._call()
