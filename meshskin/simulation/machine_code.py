"""The closed loop's step and the taxels' readings as machine code: many steps a call (steps.c)."""

from __future__ import annotations

import ctypes
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core import codegen
from ..core.content_cache import cached_by_content
from ..core.se3 import Array
from ..geometry.surface.patch import POWERS
from .closed_loop_model import PARAMETERS, REFERENCE, ClosedLoopModel
from .step import step

FLAGS = (*codegen.FLAGS, "-fno-trapping-math", *codegen.fma_flags())
PATCH, MAP = 3 * len(POWERS), 6
TINY = 1e-24
"""m^2, in place of a patch's squared radius where there is no contact."""
WORTHWHILE = 100_000
"""Steps of a run above which a C compiler's second or two is won back."""
_WHOLE, _REAL, _ADDRESS = ctypes.c_int64, ctypes.c_double, ctypes.c_void_p


class MachineCode:
    """Steps of a loop over surface patches (faces, 21, 3), and the readings of taxels."""

    def __init__(self, library: ctypes.CDLL, step: ca.Function, patches: Array) -> None:
        library.steps.restype = _WHOLE
        library.steps.argtypes = [
            _WHOLE, *[_ADDRESS] * 7, _WHOLE, _ADDRESS, _REAL, _WHOLE
        ]  # fmt: skip
        self._library, self._patches = library, np.ascontiguousarray(patches)
        self.sizes = step.size1_in(0), step.size1_out(1)
        """Of a state and of an output."""

    def steps(
        self,
        before: Array,
        after: Array,
        references: Array,
        faces: NDArray[np.intp],
        maps: Array,
        parameters: Array,
        outputs: Array,
        spare: float = np.inf,
        until_touch: bool = False,
    ) -> int:
        """Steps from `before` (k, n) to `after` (k, n), with `outputs` (k, m); see steps.c.

        references (k, 18), faces (k,), maps (k, 6); parameters (k, 9), or (9,) for all. All arrays
        are contiguous. Returns how many steps were done: all, if `spare` is infinite.
        """
        stride = PARAMETERS if parameters.ndim == 2 else 0
        arrays = (before, after, references, self._patches, faces, maps, parameters)
        assert all(a.flags.c_contiguous for a in (*arrays, outputs))
        done: int = self._library.steps(
            len(faces), *(a.ctypes.data for a in arrays), stride, outputs.ctypes.data,
            spare, until_touch,
        )  # fmt: skip
        return done

    def read(self, taxels: Array, outputs: Array, out: Array) -> None:
        """Pressures `out` (k, taxels), Pa, of `outputs` (k, m) at taxels (3, taxels), m."""
        assert taxels.flags.c_contiguous
        assert outputs.flags.c_contiguous
        assert out.flags.c_contiguous
        read = self._library.read_double if out.dtype == np.float64 else self._library.read_float
        addresses = (_ADDRESS(a.ctypes.data) for a in (taxels, outputs, out))
        read(_WHOLE(len(outputs)), _WHOLE(taxels.shape[1]), *addresses)


def machine_code(
    loop: ClosedLoopModel, patches: Array, compile_: str, steps: float
) -> MachineCode | None:
    """The step for a run of about `steps` steps: compiled if that pays ("auto"), always or never.

    A machine code that an earlier run left in the cache is used by "auto" whatever the length.
    """
    one = step(loop)
    if compile_ == "never" or not one.is_a("SXFunction"):
        return None  # CVODES is SUNDIALS' own machine code
    text = source(loop)
    pays = compile_ == "always" or steps >= WORTHWHILE
    library = (
        codegen.compile_library("step", text, FLAGS)
        if pays
        else codegen.cached_library(text, FLAGS)
    )
    return None if library is None else MachineCode(library, one, patches)


@cached_by_content
def source(loop: ClosedLoopModel) -> str:
    """C source of a loop's step over many states, and of the readings."""
    one = step(loop)
    inputs: Any = [
        ca.SX.sym(name, *shape)
        for name, shape in (
            ("state", (one.size1_in(0),)),
            ("reference", (REFERENCE,)),
            ("patch", (3, len(POWERS))),  # a row of the surface's patches, column-major
            ("map", (MAP,)),
            ("parameters", (PARAMETERS,)),
        )
    ]
    state, reference, patch, change, parameters = inputs
    anchor = ca.vertcat(ca.vec(patch.T), change)
    flat = ca.Function("step", inputs, one(state, reference, anchor, parameters))
    rows = {name.upper(): rows.start for name, rows in loop.outputs.items()}
    sizes = {"STATE": one.size1_in(0), "OUTPUT": one.size1_out(1), "REFERENCE": REFERENCE}
    sizes |= {"PATCH": PATCH, "MAP": MAP, "PARAMETERS": PARAMETERS}
    after, read = (
        Path(__file__).with_name(name).read_text(encoding="utf-8")
        for name in ("steps.c", "readings.c")
    )
    layout = [f"#define {name} {value}" for name, value in (rows | sizes | {"TINY": TINY}).items()]
    return "\n".join([codegen.INLINE, codegen.c_source(flat), *layout, after, read])
