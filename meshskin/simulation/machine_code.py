"""The closed loop's step as machine code: many steps a call.

CasADi generates C for the step; steps.c holds the loop around it.
"""

from __future__ import annotations

import ctypes
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core import codegen
from ..core.arrays import Array
from ..core.content_cache import cached_by_content
from ..geometry.surface.patch import POWERS
from .closed_loop_model import PARAMETERS, REFERENCE, ClosedLoopModel
from .integrators import step
from .track import FACE_MARGIN, Track

FLAGS = (*codegen.FLAGS, "-fno-trapping-math", *codegen.fma_flags())
PATCH, MAP = 3 * len(POWERS), 6
"""Lengths of a flattened surface patch and of a face map."""
MIN_COMPILED_STEPS = 15_000
"""Steps of a run from which on it is compiled. Machine code saves 18 to 21 us of processor time a
step, 0.3 s of 15,000 steps, against 0.55 s that the compiler takes once with a Puma 560: with so
few it pays from the second run on, which finds it in the cache (`simulate` of the scene `sphere`,
23,554 steps, with loop.compile "never", and "always" twice with an empty MESHSKIN_CACHE)."""
_INT, _REAL, _POINTER = ctypes.c_int64, ctypes.c_double, ctypes.c_void_p


class MachineCode:
    """Compiled steps over surface patches (faces, 21, 3): a rollout, see rollout.py."""

    lengths = (32, 512)
    """Steps a call; it stops where the run is cut off."""

    def __init__(self, library: ctypes.CDLL, step: ca.Function, patches: Array) -> None:
        library.steps.restype = _INT
        library.steps.argtypes = [
            _INT, *[_POINTER] * 7, _INT, _POINTER, _REAL, _INT
        ]  # fmt: skip
        self._library, self._patches = library, np.ascontiguousarray(patches)
        sizes = step.size1_in(0), step.size1_out(1)
        self._states, self._outputs = (np.zeros((self.lengths[1] + 1, k)) for k in sizes)

    def run(
        self, state: Array, track: Track, parameters: Array, until_touch: bool
    ) -> tuple[Array, Array]:
        """States (k + 1, n) and outputs (k, m) along a track; see rollout.py."""
        states, outputs, count = self._states, self._outputs[: len(track)], len(track)
        states[0] = state
        inputs = track.references, track.faces, track.maps, parameters
        done = self.steps(
            states[:count], states[1 : count + 1], *inputs, outputs, FACE_MARGIN, until_touch
        )
        return states[: done + 1], outputs[:done]

    def steps(
        self,
        before: Array,
        after: Array,
        references: Array,
        faces: NDArray[np.intp],
        maps: Array,
        parameters: Array,
        outputs: Array,
        margin: float = np.inf,
        until_touch: bool = False,
    ) -> int:
        """Step from `before` (k, n) to `after` (k, n), with `outputs` (k, m); see steps.c.

        references (k, 18), faces (k,), maps (k, 6); parameters (k, 9), or (9,) for all. All arrays
        must be contiguous. Ends early where a foot point leaves its face by more than `margin`, or,
        if `until_touch`, at the first contact. Returns the number of steps done.
        """
        stride = PARAMETERS if parameters.ndim == 2 else 0
        arrays = (before, after, references, self._patches, faces, maps, parameters)
        assert all(a.flags.c_contiguous for a in (*arrays, outputs))
        done: int = self._library.steps(
            len(faces), *(a.ctypes.data for a in arrays), stride, outputs.ctypes.data,
            margin, until_touch,
        )  # fmt: skip
        return done


def machine_code(
    loop: ClosedLoopModel, patches: Array, compile_: str, steps: float
) -> MachineCode | None:
    """The compiled step for a run of about `steps` steps, or None.

    compile_: "always", "never", or "auto": where it pays, or where an earlier run has left the
    machine code in the cache. CVODES is compiled as it is.
    """
    function = step(loop)
    if compile_ == "never" or not function.is_a("SXFunction"):
        return None
    text = source(loop)
    pays = compile_ == "always" or steps >= MIN_COMPILED_STEPS
    library = (
        codegen.compile_library("step", text, FLAGS)
        if pays
        else codegen.cached_library(text, FLAGS)
    )
    return None if library is None else MachineCode(library, function, patches)


@cached_by_content
def source(loop: ClosedLoopModel) -> str:
    """C source of a loop's step over many states."""
    function = step(loop)
    inputs: Any = [
        ca.SX.sym(name, *shape)
        for name, shape in (
            ("state", (function.size1_in(0),)),
            ("reference", (REFERENCE,)),
            ("patch", (3, len(POWERS))),  # a row of the surface's patches, column-major
            ("map", (MAP,)),
            ("parameters", (PARAMETERS,)),
        )
    ]
    state, reference, patch, face_map, parameters = inputs
    anchor = ca.vertcat(ca.vec(patch.T), face_map)
    flat = ca.Function("step", inputs, function(state, reference, anchor, parameters))
    rows: dict[str, float] = {name.upper(): s.start for name, s in loop.outputs.items()}
    sizes: dict[str, float] = {"STATE": function.size1_in(0), "OUTPUT": function.size1_out(1)}
    sizes |= {"REFERENCE": REFERENCE, "PATCH": PATCH, "MAP": MAP, "PARAMETERS": PARAMETERS}
    steps = Path(__file__).with_name("steps.c").read_text(encoding="utf-8")
    layout = [f"#define {name} {value}" for name, value in (rows | sizes).items()]
    return "\n".join([codegen.INLINE, codegen.c_source(flat), *layout, steps])
