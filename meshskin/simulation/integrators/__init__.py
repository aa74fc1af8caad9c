"""Integrators of the closed loop, one a file: each makes the function of one step.

`step(loop) -> Function` maps (state, reference, anchor, parameters) to (next state, output). The
state (2 n + memory + 2,) is q, qdot, the delayed measurements (surface_contact.py) and the foot
point (u, v); without an arm see quasi_static.py. reference (18,): pose and twist of the body along
the path, world frame. anchor (69,): patch of the foot point's face and map from the previous face.
parameters (9,). output, at the start of the step: see ClosedLoopModel.outputs. The surface enters
as the patch of one face and the foot point on it, so that a step costs the same on any mesh.
"""

from __future__ import annotations

from importlib import import_module

import casadi as ca

from ...core.content_cache import cached_by_content
from ..closed_loop_model import ClosedLoopModel

NAMES = ["state", "reference", "anchor", "parameters"], ["next", "output"]
"""Names of a step function's inputs and outputs."""


def step_function(inputs: list[ca.SX], after: ca.SX, output: ca.SX) -> ca.Function:
    """The function of a step from its expressions."""
    return ca.Function("step", inputs, [after, output], *NAMES, {"cse": True})


@cached_by_content
def step(loop: ClosedLoopModel) -> ca.Function:
    """The step of the loop's integrator; of "quasi_static" in the mode of that name."""
    name = "quasi_static" if loop.mode == "quasi_static" else loop.integrator
    function: ca.Function = import_module(f".{name}", __name__).step(loop)
    return function
