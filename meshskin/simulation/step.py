"""One step of the closed loop as a CasADi function, and blocks of many steps called at once.

The surface enters as the patch of one face (a parameter), the foot of the indenter's centre on it
as a state, so that a step costs the same on any mesh. `Blocks` maps the step over many, each with
its own reference and face.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from ..core.content_cache import cached_by_content
from . import integrators, quasi_static
from .closed_loop_model import ANCHOR, PARAMETERS, REFERENCE, ClosedLoopModel, flat_anchor

__all__ = ["ANCHOR", "PARAMETERS", "REFERENCE", "Blocks", "ClosedLoopModel", "step"]


@cached_by_content
def step(loop: ClosedLoopModel) -> ca.Function:
    """(state, reference, anchor, parameters) -> (next state, output).

    state (2 n + 2): q, qdot, (u, v) of the foot, or quasi_static's (9); reference (18,): pose and
    twist of the body along the path (world); anchor (69,): patch of the foot's face and how the
    last foot's (u, v) are carried there; parameters (9,); output as Loop.outputs says.
    """
    return quasi_static.step(loop) if loop.mode == "quasi_static" else integrators.step(loop)


class Blocks:
    """The step function mapped over `length` steps, called without CasADi's Python overhead.

    `state`, `references`, `anchors` and `parameters` are read; `states` (after each step) and
    `outputs` (before it) are filled. They must stay the same objects.
    """

    def __init__(self, loop: ClosedLoopModel, length: int, one: ca.Function | None = None) -> None:
        one = step(loop) if one is None else one
        self.length, self.loop = length, loop
        self.state = np.zeros(one.size1_in(0))
        self.references = np.zeros((length, REFERENCE))
        self.anchors = np.tile(flat_anchor(np.zeros((21, 3))), (length, 1))
        self.parameters = np.array(loop.parameters.values, dtype=float)
        self.states = np.zeros((length, one.size1_out(0)))
        self.outputs = np.zeros((length, one.size1_out(1)))
        state, references, anchors, parameters = (
            ca.MX.sym(name, *shape)
            for name, shape in (
                ("state", self.state.shape),
                ("references", self.references.T.shape),
                ("anchors", self.anchors.T.shape),
                ("parameters", self.parameters.shape),
            )
        )
        mapped = one.mapaccum("steps", length)
        after, before = mapped(state, references, anchors, ca.repmat(parameters, 1, length))
        function = ca.Function("block", [state, references, anchors, parameters], [after, before])
        inputs: tuple[Any, ...] = (self.state, self.references, self.anchors, self.parameters)
        results: tuple[Any, ...] = (self.states, self.outputs)
        buffer: Any = function.buffer()  # CasADi's stub wants sizes that it does not take
        self._buffer, self._run = buffer
        for k, array in enumerate(inputs):
            self._buffer.set_arg(k, memoryview(array))
        for k, array in enumerate(results):
            self._buffer.set_res(k, memoryview(array))

    @property
    def run(self) -> Callable[[], None]:
        """Run the block."""
        return self._run
