"""Adaptive exploration: after a first pass, contacts go where they tell most.

Rounds of touch, calibrate, and `Calibration.next_contacts`, until the stated uncertainty of every
taxel is below a target, or nothing that can be touched brings it there.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ..core.arguments import check_integer, check_real, check_type
from ..core.errors import ConfigError, ReachError
from ..core.se3 import Array
from ..exploration.lane_plan import NOT_COVERED
from ..exploration.plan import plan_exploration
from ..recording.recording import Recording
from ..scene.scene import Scene
from ..simulation.contact_samplers import ContactSamplerFactory, concatenate, static_sampler
from .calibrate import calibrate
from .calibration import Calibration

FIRST_SPACING, FIRST_STEP = 0.9, 0.9
"""Distances between the first pass's lanes, and between contacts along them, in distances at which
a contact is felt."""
GAP = 0.5
"""Distance from all contacts, in the same unit, at which a silent taxel is looked for."""
BATCH = 0.2
"""Contacts of a round, relative to all so far."""
LEAST_BATCH = 8
"""Contacts of a round at least."""
FRUITLESS = 0.98
"""Part to which a round must bring down the worst uncertainty to be worth another one."""
PATIENCE = 3
"""Rounds without that after which the worst taxel is given up."""

NEVER = "never read"
STUCK = "further contacts tell nothing more"
SPENT = "the contacts allowed are used up"


@dataclass(frozen=True)
class Round:
    """Where an adaptive exploration stood after a round."""

    contacts: int
    """So far."""
    mean_sigma: float
    """Mean standard deviation, m, of the taxels that are determined."""
    worst_sigma: float
    """The largest, m, of those that are not given up; infinite where one is not determined."""
    above: int
    """Taxels above the target or not determined, given up or not."""
    positions: Array
    """(n, 3), m: the estimates."""


@dataclass(frozen=True)
class Adaptive:
    """What an adaptive exploration found."""

    recording: Recording
    """Of all contacts."""
    calibration: Calibration
    """From all of them."""
    rounds: tuple[Round, ...]
    unmet: Mapping[int, str]
    """Why each taxel (by id) above the target is so."""

    def __repr__(self) -> str:
        return (
            f"<Adaptive: {len(self.rounds)} rounds, {len(self.recording.time)} contacts, "
            f"{len(self.unmet)} of {len(self.calibration.ids)} taxels above the target>"
        )


def adapt(
    scene: Scene,
    target: float,
    *,
    seed: int = 0,
    most: int = 2000,
    touch: ContactSamplerFactory = static_sampler,
    points: Array | None = None,
) -> Adaptive:
    """Explore until the stated uncertainty of every taxel is at most `target` (m) or cannot be.

    The uncertainty is `Calibration.position_sigma`. most: contacts in all. touch: `pressed`, or
    `touched` for the closed loop with the arm. points (k, 3): of the first pass; by default sparse
    contacts on geodesic lanes. Raises ConfigError for a target that is not positive or that any
    touch would meet, and for fewer contacts than the first pass has; ReachError where nothing can
    be touched.
    """
    check_type(Scene, scene, "what is explored")
    check_real("target of an adaptive exploration", target)
    check_integer("most contacts", most, least=1)
    _check_target(target, scene.rig.sensing_radius)
    unreachable: Mapping[int, str] = {}
    if points is None:
        points, unreachable = first_pass(scene)
    points = _checked(points, most)
    belief, stand = scene.belief(), _Standing(target, dict(unreachable))
    reach_out = touch(scene, seed)
    recording, _ = reach_out(points)
    if not calibrate(recording, belief).touched.all():
        gaps = between(scene, recording.points)[: most - len(recording.time)]
        recording = concatenate(recording, reach_out(gaps)[0]) if len(gaps) else recording
    while True:
        calibration = calibrate(recording, belief)
        left = stand.judge(calibration, len(recording.time), most)
        if left <= 0:
            return Adaptive(recording, calibration, tuple(stand.rounds), stand.unmet)
        batch = min(max(LEAST_BATCH, int(BATCH * len(recording.time))), left)
        wanted = _without(calibration, stand.unmet).next_contacts(batch)
        enough = int(np.argmax(wanted.worst <= target)) + 1 if wanted.worst[-1] <= target else batch
        try:
            more, why = reach_out(wanted.points[:enough])
        except ReachError:
            stand.give_up(wanted.taxel[:enough], "no contact that would tell more can be made")
            continue
        recording = concatenate(recording, more)
        for taxel in np.unique(wanted.taxel[:enough]):
            mine = why[wanted.taxel[:enough] == taxel]
            if (mine != "").all():
                stand.give_up(np.array([taxel]), str(mine[0]))


def _check_target(target: float, reach: float) -> None:
    if not 0 < target < reach:
        raise ConfigError(
            "the target of an adaptive exploration",
            value=f"{target} m",
            limit=f"above 0, below the {reach:.2g} m at which a contact is felt",
        )


def _checked(points: Array, most: int) -> Array:
    """The points (k, 3) of the first pass. Raises ConfigError."""
    points = np.asarray(points, dtype=float)
    if points.ndim != 2 or points.shape[1] != 3 or not len(points):
        raise ConfigError(
            "the points of the first pass", value=f"shape {points.shape}", limit="(k, 3), k > 0"
        )
    if len(points) > most:
        raise ConfigError(
            "the first pass takes all contacts allowed",
            value=f"{len(points)} contacts",
            limit=f"most={most}",
            remedy="allow more, or give fewer points",
        )
    return points


class _Standing:
    """What is reached, and which taxels are given up."""

    def __init__(self, target: float, unmet: dict[int, str]) -> None:
        self.target, self.unmet = target, unmet
        self.rounds: list[Round] = []
        self._record: tuple[float, float] = (np.inf, np.inf)
        self._vain = 0

    def give_up(self, taxels: Array, why: str) -> None:
        """Aim at these taxels no more."""
        self.unmet |= {int(k): why for k in taxels}

    def judge(self, calibration: Calibration, contacts: int, most: int) -> int:
        """Note the round; how many contacts may still be made, 0 when it is over."""
        sigma = np.where(
            calibration.observed[:, :2].all(axis=1), calibration.position_sigma, np.inf
        )
        above = sigma > self.target
        self.unmet = {k: w for k, w in self.unmet.items() if above[calibration.ids == k].all()}
        open_ = above & ~np.isin(calibration.ids, list(self.unmet))
        silent = open_ & ~calibration.touched
        self.give_up(calibration.ids[silent], NEVER)
        open_ &= ~silent
        aimed = ~np.isin(calibration.ids, list(self.unmet))
        worst = float(sigma[aimed].max(initial=0.0))
        known = sigma[np.isfinite(sigma)]
        mean = float(known.mean()) if len(known) else np.inf
        self.rounds.append(Round(contacts, mean, worst, int(above.sum()), calibration.positions))
        if open_.any() and contacts >= most:
            self.give_up(calibration.ids[open_], SPENT)
            return 0
        # what is not determined yet counts first, then the worst of what is
        lost = float((~np.isfinite(sigma[open_])).sum())
        last = float(sigma[open_ & np.isfinite(sigma)].max(initial=0.0))
        better = lost < self._record[0] or last < FRUITLESS * self._record[1]
        self._vain = 0 if better else self._vain + 1
        self._record = min(lost, self._record[0]), min(last, self._record[1])
        if self._vain == PATIENCE and open_.any():
            hopeless = open_ & (sigma >= worst)
            self.give_up(calibration.ids[hopeless], STUCK)
            open_ &= ~hopeless
            self._record, self._vain = (np.inf, np.inf), 0
        return most - contacts if open_.any() else 0


def first_pass(
    scene: Scene, spacing: float = FIRST_SPACING, step: float = FIRST_STEP
) -> tuple[Array, Mapping[int, str]]:
    """Contact points (k, 3) on geodesic lanes, their distances in distances at which a contact is
    felt, and the taxels that cannot be reached.
    """
    reach = scene.rig.sensing_radius
    lanes = replace(scene.exploration, pattern="lanes", lane_spacing=spacing * reach, contacts=None)
    found = plan_exploration(scene.with_(exploration=lanes))
    parts = []
    for place in found.segments:
        way = np.linalg.norm(np.diff(place.points, axis=0), axis=1)
        along = np.concatenate([[0.0], np.cumsum(way)])
        parts.append(place.points[np.searchsorted(along, np.arange(0.0, along[-1], step * reach))])
    hopeless = {k: why for k, why in found.unreachable.items() if why != NOT_COVERED}
    return np.concatenate(parts), hopeless


def between(scene: Scene, points: Array) -> Array:
    """Contact points (k, 3) in the gaps of a first pass at `points` (m, 3), for silent taxels."""
    from scipy.spatial import cKDTree

    dense, _ = first_pass(scene, GAP, GAP)
    return dense[cKDTree(points).query(dense)[0] > GAP * scene.rig.sensing_radius]


def _without(calibration: Calibration, given_up: Mapping[int, str]) -> Calibration:
    """The calibration with nothing known of some taxels, so that none is aimed at."""
    rows = np.isin(calibration.ids, list(given_up))
    poses, observed = calibration.poses.copy(), calibration.observed.copy()
    poses[rows], observed[rows] = np.nan, False
    middles = (
        None if calibration.contact_centroids is None else calibration.contact_centroids.copy()
    )
    if middles is not None:
        middles[rows] = np.nan
    return replace(calibration, poses=poses, observed=observed, contact_centroids=middles)
