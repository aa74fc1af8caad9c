"""A replay: a part of a scene's exploration that is simulated once and read with any effects.

Effects act on the contacts of the closed loop and never on the loop itself, so that one motion
serves any choice of effects. With the same seed, the random numbers of common effects are equal.
The skin is cut by a plane into two halves, one for the estimate and one for the check (Holdout).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ...core.arrays import Array
from ...effects import Effect, EffectPipeline, NoiseEffect, ordered
from ...effects.frames import Frames
from ...estimation.calibrate import calibrate
from ...estimation.joint.reduced_nlp import NEWTON_TOLERANCE
from ...exploration.path import Path
from ...exploration.plan import plan_exploration
from ...recording.recording import Recording
from ...scene.belief import Belief
from ...scene.scene import Scene
from ...simulation.readout import contact_frames, effect_pipeline, sensor_tables
from ...simulation.simulate import prepare, run
from .budget_report import Check
from .selection import mean_length
from .trial import timed

LONGEST = 40.0
"""Longest part of the path, s: above the 23 s of the whole path of the paper's sphere."""
CELLS = 4e6
"""Most pressures (frames times taxels): 32 MB."""
CONTACT_STAGES = ("contact", "field")
"""Stages of effects that change the pressures on the skin."""
RECORDED_STAGES = ("geometry", "robot")
"""Stages of effects that change the recorded contacts."""
MARGIN = 5
"""Frames next to those of a half that are computed, too: effects with a memory use them."""
FEWEST_TAXELS = 6
"""Fewest taxels of a half; with fewer, both halves are the whole skin."""


@dataclass(frozen=True)
class Halves:
    """The skin, cut into two halves by a plane through its centroid."""

    origin: Array
    """Point of the plane (3,), m."""
    normal: Array
    """Normal of the plane (3,)."""
    taxels: tuple[np.ndarray, np.ndarray]
    """Rows of the taxels of each half all of whose contacts are in it."""
    cut: bool
    """False if there are too few taxels: both halves are the whole skin."""

    def frames(self, points: Array, half: int) -> np.ndarray:
        """Which of the contact points (m, 3) belong to a half (0 or 1)."""
        if not self.cut:
            return np.ones(len(points), dtype=bool)
        return ((points - self.origin) @ self.normal > 0) == (half == 0)


@dataclass
class Replay:
    """The contacts of a scene's exploration, or of its first part."""

    scene: Scene
    frames: Frames
    frames_in_all: float
    """Frames of the whole exploration."""
    steps_in_all: int
    """Steps of the closed loop of the whole exploration."""
    path: Array
    """Contact points (k, 3) of the whole path, body frame, m."""
    replayed: int
    """Number of points of the path that are replayed."""
    _pressed: dict[tuple[Any, ...], tuple[Frames, Array]] = field(default_factory=dict, repr=False)
    """Pressures on the skin, by seed, half and effects."""
    _recorded: dict[tuple[Any, ...], Frames] = field(default_factory=dict, repr=False)
    """Recorded contacts, by seed and effects."""

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
        """The recording with these effects; of one half only, if halves are given."""
        scene, mine = self.scene.with_(effects=ordered(effects)), np.ones(len(self.frames), bool)
        if halves is not None:
            mine = halves.frames(self.frames.points, half)
        chain = effect_pipeline(scene, seed)
        pressed_key = (seed, half, *(e for e in scene.effects if e.stage in CONTACT_STAGES))
        if pressed_key not in self._pressed:
            self._pressed[pressed_key] = self._press(chain, mine)
        frames, pressures = self._pressed[pressed_key]
        recorded_key = (seed, *(e for e in scene.effects if e.stage in RECORDED_STAGES))
        if recorded_key not in self._recorded:
            self._recorded[recorded_key] = chain.record(self.frames)
        recorded = self._recorded[recorded_key]
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
        """The frames with the effects on contacts, and pressures (m, n), Pa, in the frames `mine`
        (m,) and a few next to them; zero in the others.
        """
        frames, poses = self.frames, self.scene.skin.poses
        for act in chain.contact:
            frames = act(frames)
        rows = np.convolve(mine, np.ones(2 * MARGIN + 1), mode="same") > 0
        pressures = np.zeros((len(frames), len(poses)))
        if rows.any():
            pressures[rows] = chain.field(frames.rows(rows), poses)
        return frames, pressures

    def halves(self) -> Halves:
        """Cut the skin across its longest direction.

        A taxel belongs to a half if every contact of the whole exploration that reaches it is in
        that half and replayed, so that it has all its readings there.
        """
        from scipy.spatial import cKDTree

        scene = self.scene
        reach = float(max(scene.patch.semi_axes)) + scene.skin.disc_radius
        positions = np.asarray(scene.skin.positions)
        later = cKDTree(self.path[self.replayed :])
        ready = np.flatnonzero(later.query(positions)[0] > reach)
        ready = ready if len(ready) else np.arange(len(positions))
        origin = positions[ready].mean(axis=0)
        normal = np.linalg.svd(positions[ready] - origin)[2][0]
        side = (positions[ready] - origin) @ normal
        cut = ready[side > reach], ready[side < -reach]
        if min(map(len, cut)) < FEWEST_TAXELS:
            return Halves(origin, normal, (ready, ready), False)
        return Halves(origin, normal, cut, True)


def without_common_noise(everything: Scene, chosen: Scene) -> tuple[Scene, Scene]:
    """Both scenes without the white noise that they have in common.

    At another time step the same random numbers fall on other contacts; they would move the taxels
    although nothing was left out.
    """
    common = {e.name for e in chosen.effects if isinstance(e, NoiseEffect)}
    quiet = [
        scene.with_(effects=tuple(e for e in scene.effects if e.name not in common))
        for scene in (everything, chosen)
    ]
    return quiet[0], quiet[1]


@dataclass
class Holdout:
    """Contacts and seeds that no estimate has used."""

    everything: Scene
    """The scene with everything on."""
    belief: Belief
    path: Path
    halves: Halves
    """The second half is kept aside."""
    seeds: Sequence[int]
    _known: dict[tuple[Effect, ...], tuple[Array, float]] = field(default_factory=dict, repr=False)
    """Positions and seconds with everything on, by the effects of it that were on."""

    def check(self, chosen: Scene, tolerance: float) -> Check:
        """Compare everything on with a chosen scene, whose calibration stops at `tolerance`.

        Raises as `simulate` and `calibrate`.
        """
        every, chosen = without_common_noise(self.everything, chosen)
        if every.effects not in self._known:
            self._known[every.effects] = self._calibrated(every, NEWTON_TOLERANCE)
        truth, slow = self._known[every.effects]
        found, fast = self._calibrated(chosen, tolerance)
        shift = (found - truth)[:, self.halves.taxels[1]]
        taxels = int(np.isfinite(shift[..., 0]).sum()) // max(len(shift), 1)
        known, there = (np.isfinite(x[:, self.halves.taxels[1], 0]) for x in (truth, found))
        return Check(mean_length(shift), taxels, int((known & ~there).sum()), (slow, fast))

    def _calibrated(self, scene: Scene, tolerance: float) -> tuple[Array, float]:
        """Positions (seeds, n, 3), m, and the processor seconds of a run for them."""

        def work() -> Array:
            fresh = scene.with_(body=replace(scene.body))  # so that the fit of its surface counts
            plan_exploration(fresh)  # a run plans its own path
            replay = Replay.of(fresh, self.path)
            recordings = [replay.recording(scene.effects, s, self.halves, 1) for s in self.seeds]
            found = [calibrate(r, self.belief, tolerance=tolerance) for r in recordings]
            return np.stack([calibration.positions for calibration in found])

        return timed(work)
