"""One source for NumPy and CasADi: the formulas are written once and take either."""

from __future__ import annotations

from typing import Any

import numpy as np


def is_casadi(*values: Any) -> bool:
    """Whether any of `values` is a CasADi matrix."""
    return any(type(value).__module__.split(".")[0] == "casadi" for value in values)


def functions(*values: Any) -> Any:
    """The module whose sqrt, exp, log, fmin, fmax, atan2 take `values`: casadi or numpy."""
    if not is_casadi(*values):
        return np
    import casadi

    return casadi
