"""Steps in a row along a track, until the foot leaves its faces: interpreted or in machine code."""

from __future__ import annotations

from typing import Protocol

import casadi as ca
import numpy as np

from ..core.se3 import Array
from ..geometry.surface.surface import Surface
from .closed_loop_model import ClosedLoopModel
from .machine_code import MachineCode
from .step import Blocks
from .track import STAY, Track

LENGTHS = (32, 256)
"""Steps a call: short where the run may be cut, long along the path."""
COMPILED_LENGTHS = (32, 512)
CVODES_LENGTHS = (1, 8)
SPARE = 0.25
"""How far, in barycentric weight, the foot may leave its face."""

Run = tuple[Array, Array]


class Rollout(Protocol):
    """Runs the closed loop along tracks."""

    lengths: tuple[int, int]

    def run(self, state: Array, track: Track, parameters: Array, until_touch: bool) -> Run:
        """States (k + 1, n), `state` the first, and outputs (k, m), good until the next run.

        k is the track's length, but no step follows one whose foot lies further than SPARE outside
        its face, or, if `until_touch`, one in contact. parameters (9,): see loop.Parameters.
        """


class CompiledRollout:
    """Machine code: no step is done in vain."""

    lengths = COMPILED_LENGTHS

    def __init__(self, code: MachineCode) -> None:
        self._code = code
        self._states, self._outputs = (np.zeros((self.lengths[1] + 1, k)) for k in code.sizes)

    def run(self, state: Array, track: Track, parameters: Array, until_touch: bool) -> Run:
        """See Stretch."""
        states, outputs, count = self._states, self._outputs, len(track)
        states[0] = state
        done = self._code.steps(
            states[:count],
            states[1 : count + 1],
            track.references,
            track.faces,
            track.maps,
            parameters,
            outputs[:count],
            SPARE,
            until_touch,
        )
        return states[: done + 1], outputs[:done]


class InterpretedRollout:
    """CasADi's virtual machine, in blocks of the two lengths."""

    def __init__(self, loop: ClosedLoopModel, step: ca.Function, surface: Surface) -> None:
        self.lengths = CVODES_LENGTHS if loop.integrator == "cvodes" else LENGTHS
        self._blocks = [Blocks(loop, length, step) for length in self.lengths]
        self._surface, self._force = surface, loop.outputs["force"].start
        self._rows: dict[int, Array] = {}

    def run(self, state: Array, track: Track, parameters: Array, until_touch: bool) -> Run:
        """See Stretch."""
        blocks, count = self._blocks[len(track) > self.lengths[0]], len(track)
        blocks.state[:], blocks.parameters[:] = state, parameters
        self._fill(blocks, track)
        blocks.run()
        states, outputs = blocks.states[:count], blocks.outputs[:count]
        ends = ~(np.minimum(states[:, -2:].min(axis=1), 1.0 - states[:, -2:].sum(axis=1)) >= -SPARE)
        if until_touch:
            ends |= outputs[:, self._force] > 0
        count = int(np.argmax(ends)) + 1 if ends.any() else count
        return np.concatenate([state[None], states[:count]]), outputs[:count]

    def _fill(self, blocks: Blocks, track: Track) -> None:
        """Set a block's references and anchors."""
        count, faces, anchors = len(track), track.faces, blocks.anchors
        blocks.references[:count] = track.references
        anchors[:count, -len(STAY) :] = track.maps
        first = 0
        for end in [*(np.flatnonzero(np.diff(faces)) + 1).tolist(), count]:
            anchors[first:end, : -len(STAY)] = self._row(int(faces[first]))
            first = end
        if count < blocks.length:  # the rest runs too, for nothing: let it run where it can
            blocks.references[count:] = blocks.references[count - 1]
            anchors[count:, : -len(STAY)] = self._row(int(faces[-1]))
            anchors[count:, -len(STAY) :] = STAY

    def _row(self, face: int) -> Array:
        """Patch of a face (63,), column-major."""
        if face not in self._rows:
            self._rows[face] = self._surface.patches[face].T.ravel()
        return self._rows[face]
