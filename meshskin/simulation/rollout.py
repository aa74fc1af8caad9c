"""Rollouts: consecutive steps along a track until the foot point leaves its faces.

`run(state, track, parameters, until_touch)` returns states (k + 1, n), `state` first, and outputs
(k, m), valid until the next run. k is the track's length or less: the run ends after a step whose
foot point lies further than FACE_MARGIN outside its face, or, if `until_touch`, after the first
step in contact. parameters (9,): see closed_loop_model.Parameters.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ..core.arrays import Array
from ..core.errors import PlaceError, ReachError
from ..geometry.surface.surface import Surface
from .closed_loop_model import REFERENCE, ClosedLoopModel, flat_anchor
from .integrators import step
from .machine_code import PATCH, MachineCode
from .track import FACE_MARGIN, IDENTITY_MAP, Track, face_margin

LENGTHS = (32, 256)
"""Steps a call: short where the run may be cut off, which wastes the rest; long along the path,
where a call's overhead is spread over more steps."""
CVODES_LENGTHS = (1, 8)
"""Steps a call of CVODES, whose steps take milliseconds each."""


@dataclass(frozen=True)
class Steps:
    """Consecutive steps of the closed loop, as they were run."""

    time: Array
    """(k,), s."""
    q: Array
    """Configuration (k, n): joint angles, or position and quaternion of the body."""
    outputs: Array
    """(k, m), see ClosedLoopModel.outputs."""
    phase: int
    """Phase of the exploration, an index of state_machine.PHASES."""
    reference: float
    """Reference contact force, N."""


@dataclass(frozen=True)
class GivenUp:
    """A part of the path that was given up."""

    place: int
    rows: slice
    """Rows of the place's track."""
    error: PlaceError | ReachError
    """Why."""

    def __str__(self) -> str:
        return str(self.error)


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
    """`length` consecutive steps in one call of `run`.

    `state`, `references`, `anchors` and `parameters` are read; `states` (after each step) and
    `outputs` (before it) are filled. They must stay the same objects.
    """

    def __init__(self, loop: ClosedLoopModel, length: int) -> None:
        function = step(loop)
        self.length = length
        self.state = np.zeros(function.size1_in(0))
        self.references = np.zeros((length, REFERENCE))
        self.anchors = np.tile(flat_anchor(np.zeros((21, 3))), (length, 1))
        self.parameters = np.tile(np.array(loop.parameters.values, dtype=float), (length, 1))
        self.states = np.zeros((length, function.size1_out(0)))
        self.outputs = np.zeros((length, function.size1_out(1)))
        self._buffer, self.run = bind(
            function.mapaccum("steps", length),
            (self.state, self.references, self.anchors, self.parameters),
            (self.states, self.outputs),
        )


class InterpretedRollout:
    """Steps in CasADi's virtual machine, in blocks of the two lengths."""

    def __init__(self, loop: ClosedLoopModel, surface: Surface) -> None:
        self.lengths = CVODES_LENGTHS if loop.integrator == "cvodes" else LENGTHS
        self._blocks = [StepBlock(loop, length) for length in self.lengths]
        self._surface, self._force = surface, loop.outputs["force"].start

    def run(
        self, state: Array, track: Track, parameters: Array, until_touch: bool
    ) -> tuple[Array, Array]:
        """States (k + 1, n) and outputs (k, m) along a track; see the module."""
        block, count = self._blocks[len(track) > self.lengths[0]], len(track)
        block.state[:], block.parameters[:] = state, parameters
        self._fill(block, track)
        block.run()
        states, outputs = block.states[:count], block.outputs[:count]
        ends = ~(face_margin(states[:, -2:]) >= -FACE_MARGIN)
        if until_touch:
            ends |= outputs[:, self._force] > 0
        count = int(np.argmax(ends)) + 1 if ends.any() else count
        return np.concatenate([state[None], states[:count]]), outputs[:count]

    def _fill(self, block: StepBlock, track: Track) -> None:
        """Set a block's references and anchors. The steps after the track's run, too, and are
        discarded: they rest at its last row."""
        rows = np.minimum(np.arange(block.length), len(track) - 1)
        patches = self._surface.patches[track.faces[rows]]
        block.references[:] = track.references[rows]
        block.anchors[:, :PATCH] = patches.swapaxes(1, 2).reshape(block.length, PATCH)
        block.anchors[:, PATCH:] = track.maps[rows]
        block.anchors[len(track) :, PATCH:] = IDENTITY_MAP


Rollout = MachineCode | InterpretedRollout
