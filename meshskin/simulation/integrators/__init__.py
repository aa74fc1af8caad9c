"""Integrators of the closed loop, one a file: each makes one step of ClosedLoopDynamics.

`step(loop) -> Function` maps (state, reference, anchor, parameters) to (next state, output). The
state (2 n + memory + 2,) is q, qdot, the delayed measurements (surface_contact.py) and the foot
point (u, v); the output belongs to the start of the step.
"""

from __future__ import annotations

from importlib import import_module

import casadi as ca

from ...core.arguments import check_name
from ...scene.settings import INTEGRATORS
from ..closed_loop_model import ClosedLoopModel

NAMES = ["state", "reference", "anchor", "parameters"], ["next", "output"]
"""Names of a step function's inputs and outputs."""


def step(loop: ClosedLoopModel) -> ca.Function:
    """The step of the loop's integrator. Raises UnknownNameError."""
    check_name("integrator", loop.integrator, INTEGRATORS)
    function: ca.Function = import_module(f".{loop.integrator}", __name__).step(loop)
    return function
