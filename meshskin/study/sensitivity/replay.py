"""A rehearsal: a short piece of a scene's exploration, run once and read as often as needed.

Effects act on the contacts of the closed loop and never on the loop itself, so that one motion
serves any choice of effects; with the same seed, what they have in common is the same, number by
number. The skin is cut in two by a plane: one half to estimate from, one to check with.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ...core.se3 import Array
from ...effects import Effect, EffectPipeline, ordered
from ...effects.frames import Frames
from ...recording.recording import Recording
from ...simulation.readout import contact_frames, effect_pipeline, sensor_tables
from ...simulation.simulate import prepare, run

if TYPE_CHECKING:
    from ...exploration.path import Path
    from ...scene.scene import Scene

LONGEST = 40.0
"""Most seconds of the path that are rehearsed."""
CELLS = 4e6
"""Most pressures (frames times taxels) of a rehearsal."""
CONTACT_STAGES = ("contact", "field")
"""Stages that the pressures on the skin follow from."""
RECORDED_STAGES = ("geometry", "robot")
"""Stages that what is recorded of a contact follows from."""
BESIDE = 5
"""Frames beside those of a half that are computed, too."""
FEWEST = 6
"""Fewest taxels of a half; with fewer, both halves are the whole."""


@dataclass(frozen=True)
class Halves:
    """The skin cut in two by a plane through its middle."""

    origin: Array
    """(3,), m."""
    normal: Array
    """(3,)."""
    taxels: tuple[np.ndarray, np.ndarray]
    """Rows of the taxels of either half all whose contacts are in it."""
    cut: bool
    """False where there are too few taxels: both halves are the whole."""

    def frames(self, points: Array, half: int) -> np.ndarray:
        """Which of the contact points (m, 3) belong to a half (0 or 1)."""
        if not self.cut:
            return np.ones(len(points), dtype=bool)
        return ((points - self.origin) @ self.normal > 0) == (half == 0)


@dataclass
class Replay:
    """The contacts of a scene's (shortened) exploration."""

    scene: Scene
    frames: Frames
    frames_in_all: float
    """Frames of the whole exploration."""
    steps_in_all: int
    """Steps of the closed loop of the whole exploration."""
    path: Array
    """Contact points (k, 3) of the whole path, body frame, m."""
    rehearsed: int
    """How many of them are rehearsed."""
    _pressed: dict[tuple[Any, ...], tuple[Frames, Array]] = field(default_factory=dict, repr=False)
    """The pressures on the skin, by what they follow from."""
    _recorded: dict[tuple[Any, ...], Frames] = field(default_factory=dict, repr=False)
    """The contacts as they are recorded, by what acts on them."""

    @classmethod
    def of(cls, scene: Scene, path: Path | None = None) -> Replay:
        """Run the first part of a scene's exploration, or of `path`. Raises as `simulate`."""
        if path is not None:
            path = path.resampled(scene.loop.dt, scene.body)
        machine, path = prepare(scene, path=path)
        taxels, step = max(len(scene.skin.ids), 1), scene.loop.dt
        longest = min(LONGEST, CELLS / taxels * scene.frame_steps * step)
        count = min(len(path.points), max(int(longest / step), 2))
        steps = list(run(scene, machine, path.truncated(count)))
        frames = contact_frames(scene, machine.loop, steps)
        whole = len(path.points) / scene.frame_steps
        return cls(scene, frames, whole, len(path.points), path.points, count)

    def recording(
        self, effects: Sequence[Effect], seed: int, halves: Halves | None = None, half: int = 0
    ) -> Recording:
        """What is recorded with these effects; of one half only, where halves are given."""
        scene, mine = self.scene.with_(effects=ordered(effects)), np.ones(len(self.frames), bool)
        if halves is not None:
            mine = halves.frames(self.frames.points, half)
        chain = effect_pipeline(scene, seed)
        pressed = (seed, half, *(e for e in scene.effects if e.stage in CONTACT_STAGES))
        if pressed not in self._pressed:
            self._pressed[pressed] = self._press(chain, mine)
        frames, pressures = self._pressed[pressed]
        told = (seed, *(e for e in scene.effects if e.stage in RECORDED_STAGES))
        if told not in self._recorded:
            self._recorded[told] = chain.record(self.frames)
        recorded = self._recorded[told]
        known = replace(
            chain,
            contact=(lambda _: frames,),
            field=lambda *_: pressures,
            recorded=(lambda _: recorded,),
        )
        contacts, readings = sensor_tables(scene, self.frames, known)
        header = {"taxel_ids": np.asarray(scene.skin.ids).tolist(), "threshold_pa": scene.threshold}
        whole = Recording(contacts, readings, header)
        return Recording(
            contacts.filter(mine), readings.filter(mine[whole.reading_contact]), header
        )

    def _press(self, chain: EffectPipeline, mine: np.ndarray) -> tuple[Frames, Array]:
        """What presses the skin, and the pressures (m, n), Pa, in the frames `mine` (m,); zero in
        the others, but for a few beside them that effects look back to.
        """
        frames, poses = self.frames, self.scene.skin.poses
        for act in chain.contact:
            frames = act(frames)
        rows = np.convolve(mine, np.ones(2 * BESIDE + 1), mode="same") > 0
        pressures = np.zeros((len(frames), len(poses)))
        if rows.any():
            pressures[rows] = chain.field(frames.rows(rows), poses)
        return frames, pressures

    def halves(self) -> Halves:
        """Cut the skin where it is longest.

        A taxel belongs to a half if every contact that reaches it, of the whole exploration, is in
        that half and rehearsed, so that it is told there as much as in the whole.
        """
        scene = self.scene
        reach = float(max(scene.patch.semi_axes)) + scene.skin.disc_radius
        places = np.asarray(scene.skin.positions)
        ready = np.flatnonzero(_far(places, self.path[self.rehearsed :], reach))
        ready = ready if len(ready) else np.arange(len(places))
        origin = places[ready].mean(axis=0)
        normal = np.linalg.svd(places[ready] - origin)[2][0]
        side = (places[ready] - origin) @ normal
        cut = ready[side > reach], ready[side < -reach]
        if min(map(len, cut)) < FEWEST:
            return Halves(origin, normal, (ready, ready), False)
        return Halves(origin, normal, cut, True)


def _far(places: Array, path: Array, reach: float) -> np.ndarray:
    """Which places (n, 3) are beyond `reach`, m, of all points of a path (k, 3)."""
    from scipy.spatial import cKDTree

    if not len(path):
        return np.ones(len(places), dtype=bool)
    return np.asarray(cKDTree(path).query(places)[0] > reach)
