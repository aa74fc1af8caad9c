"""Integrators of the closed loop, one a file: each makes one step of a Field.

`step(field) -> Function` takes (state, reference, anchor, parameters) to (next state, output). The
state (2 n + 2) is q, qdot and the foot (u, v), with readings that are on their way to the law
before the foot, where there is a delay (motion.delay); the output belongs to the start of the step.
"""

from __future__ import annotations

from importlib import import_module

import casadi as ca

from ...core.arguments import check_name
from ...scene.settings import INTEGRATORS
from ..closed_loop_model import ClosedLoopModel

NAMES = ["state", "reference", "anchor", "parameters"], ["next", "output"]


def step(loop: ClosedLoopModel) -> ca.Function:
    """The step of the loop's integrator. Raises UnknownNameError."""
    check_name("integrator", loop.integrator, INTEGRATORS)
    made: ca.Function = import_module(f".{loop.integrator}", __name__).step(loop)
    return made
