"""One source for NumPy and CasADi: the functions whose names or behaviour differ between them."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

_NUMPY = SimpleNamespace(sqrt=np.sqrt, fmin=np.fmin, fmax=np.fmax, atan2=np.arctan2)


def is_casadi(*values: Any) -> bool:
    """Whether any of `values` is a CasADi matrix."""
    return any(type(value).__module__.split(".")[0] == "casadi" for value in values)


def functions(*values: Any) -> Any:
    """A namespace with sqrt, fmin, fmax, atan2 for `values`: CasADi's if any is CasADi's."""
    if not is_casadi(*values):
        return _NUMPY
    import casadi

    return casadi
