"""Adaptive exploration: after a first pass, contacts are where they are most informative.

Rounds of touch, calibrate and `Calibration.next_contacts`, until the stated uncertainty of every
taxel is below a target, or no contact reduces it further.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial import cKDTree

from ..core.arguments import check_integer, check_real, check_type, check_vectors
from ..core.arrays import Array
from ..core.errors import ConfigError, ReachError
from ..core.progress import Progress, Stage
from ..core.value import Value
from ..exploration.chains import lengths_along
from ..exploration.left_out import SPARSE
from ..exploration.plan import plan_exploration
from ..recording.recording import Recording
from ..scene.scene import Scene
from ..simulation.contact_samplers import ContactSamplerFactory, concatenate, static_sampler
from .calibrate import calibrate
from .calibration import Calibration

FIRST_SPACING = 0.9
"""Distances between the lanes of the first pass, and between contacts along them, in sensing radii:
just below 1, at which every taxel is touched by few contacts."""
SECOND_SPACING = 0.5
"""Spacing of the lanes on which taxels without a reading are sought, in sensing radii; contacts
closer than this to previous ones are left out."""
BATCH = 0.2
"""Contacts of a round, relative to all previous ones."""
MIN_BATCH = 8
"""Least number of contacts of a round."""
MIN_IMPROVEMENT = 0.98
"""A round improves if the largest uncertainty falls below this fraction of the smallest so far."""
PATIENCE = 3
"""Rounds without improvement after which the most uncertain taxels are given up."""

NEVER_READ = "never read"
NO_IMPROVEMENT = "further contacts do not reduce its uncertainty"
BUDGET_USED = "the contacts allowed are used up"
NO_CONTACT = "no contact that would reduce its uncertainty can be made"


@dataclass(frozen=True, eq=False)
class Round(Value):
    """The state of an adaptive exploration after a round."""

    contacts: int
    """Contacts so far."""
    mean_sigma: float
    """Mean standard deviation, m, of the taxels that are determined."""
    worst_sigma: float
    """The largest, m, of those that are not given up; inf where one is not determined."""
    above: int
    """Taxels above the target or not determined, given up or not."""
    positions: Array
    """Estimates (n, 3), m."""


@dataclass(frozen=True)
class Adaptive:
    """The result of an adaptive exploration."""

    recording: Recording
    """All contacts."""
    calibration: Calibration
    """From all contacts."""
    rounds: tuple[Round, ...]
    unmet: Mapping[int, str]
    """The reason for each taxel (by id) above the target."""

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
    progress: Progress | None = None,
) -> Adaptive:
    """Explore until the stated uncertainty of every taxel is at most `target`, m, or cannot be.

    The uncertainty is `Calibration.position_sigma`. most: contacts in all. touch: static contacts
    by default; `closed_loop_sampler` simulates the arm. points (k, 3), m: contacts of the first
    pass; by default sparse ones on geodesic lanes. progress(stage, done, total): called after each
    round of the stage "adapt"; done are the taxels that no more contacts are made for.
    Raises ConfigError for a target outside (0, sensing radius) and for fewer contacts than the
    first pass has; ReachError if no contact can be made.
    """
    points, unreachable = _first_pass(scene, target, most, points)
    belief, rounds = scene.belief(), _Rounds(target, dict(unreachable))
    stage = Stage(progress, "adapt", len(scene.skin.ids))
    sample = touch(scene, seed)
    recording, _ = sample(points)
    if not calibrate(recording, belief).touched.all():
        gaps = _gaps(scene, recording.points)[: most - len(recording.time)]
        with suppress(ReachError):  # taxels under gaps that nothing reaches are never read
            recording = concatenate(recording, sample(gaps)[0]) if len(gaps) else recording
    while True:
        calibration = calibrate(recording, belief)
        remaining = rounds.update(calibration, len(recording.time), most)
        if remaining <= 0:
            stage.end()
            return Adaptive(recording, calibration, tuple(rounds.rounds), rounds.unmet)
        stage.at(stage.total - rounds.pending)
        batch = min(max(MIN_BATCH, int(BATCH * len(recording.time))), remaining)
        planned = _without(calibration, rounds.unmet).next_contacts(batch)
        reached = planned.worst <= target
        count = int(np.argmax(reached)) + 1 if reached[-1] else batch
        taxels = planned.taxel[:count]
        try:
            more, reasons = sample(planned.points[:count])
        except ReachError:
            rounds.give_up(taxels, NO_CONTACT)
            continue
        recording = concatenate(recording, more)
        for taxel in np.unique(taxels):
            failed = reasons[taxels == taxel]
            if (failed != "").all():
                rounds.give_up(np.array([taxel]), str(failed[0]))


def _first_pass(
    scene: Scene, target: float, most: int, points: Array | None
) -> tuple[Array, Mapping[int, str]]:
    """Points (k, 3), m, of the first pass, and why taxels (by id) cannot be reached. Raises
    ConfigError for arguments of `adapt` that cannot be used."""
    check_type(Scene, scene, "what is explored")
    check_real("target of an adaptive exploration", target)
    check_integer("most contacts", most, least=1)
    if not 0 < target < scene.rig.sensing_radius:
        raise ConfigError(
            "the target of an adaptive exploration",
            value=f"{target} m",
            limit=f"above 0, below the {scene.rig.sensing_radius:.2g} m at which a contact is felt",
        )
    unreachable: Mapping[int, str] = {}
    if points is None:
        points, unreachable = lane_contacts(scene, FIRST_SPACING)
    points = check_vectors("the points of the first pass", points)
    if not len(points):
        raise ConfigError("the first pass needs a contact", value=f"shape {points.shape}")
    if len(points) > most:
        raise ConfigError(
            "the first pass takes all contacts allowed",
            value=f"{len(points)} contacts",
            limit=f"most={most}",
            remedy="allow more, or give fewer points",
        )
    return points, unreachable


@dataclass
class _Rounds:
    """The rounds, and the taxels that are given up."""

    target: float
    unmet: dict[int, str]
    rounds: list[Round] = field(default_factory=list)
    best: tuple[float, float] = (np.inf, np.inf)
    """Fewest undetermined taxels, and smallest largest uncertainty, m, so far."""
    stagnant: int = 0
    """Rounds without improvement."""
    pending: int = 0
    """Taxels above the target that are not given up."""

    def give_up(self, taxels: Array, reason: str) -> None:
        """Plan no more contacts for these taxels (ids)."""
        self.unmet |= {int(k): reason for k in taxels}

    def update(self, calibration: Calibration, contacts: int, most: int) -> int:
        """Add a round; returns the number of contacts that may still be made, 0 at the end."""
        determined = calibration.observed[:, :2].all(axis=1)
        sigma = np.where(determined, calibration.position_sigma, np.inf)
        above = sigma > self.target
        self.unmet = {k: w for k, w in self.unmet.items() if above[calibration.ids == k].all()}
        pending = above & ~np.isin(calibration.ids, list(self.unmet))
        self.give_up(calibration.ids[pending & ~calibration.touched], NEVER_READ)
        pending &= calibration.touched
        aimed = ~np.isin(calibration.ids, list(self.unmet))
        worst = float(sigma[aimed].max(initial=0.0))
        known = sigma[np.isfinite(sigma)]
        mean = float(known.mean()) if len(known) else np.inf
        self.rounds.append(Round(contacts, mean, worst, int(above.sum()), calibration.positions))
        if pending.any() and contacts >= most:
            self.give_up(calibration.ids[pending], BUDGET_USED)
            return 0
        # undetermined taxels count first, then the most uncertain of the determined ones
        undetermined = float((~np.isfinite(sigma[pending])).sum())
        largest = float(sigma[pending & np.isfinite(sigma)].max(initial=0.0))
        better = undetermined < self.best[0] or largest < MIN_IMPROVEMENT * self.best[1]
        self.stagnant = 0 if better else self.stagnant + 1
        self.best = min(undetermined, self.best[0]), min(largest, self.best[1])
        if self.stagnant == PATIENCE and pending.any():
            hopeless = pending & (sigma >= worst)
            self.give_up(calibration.ids[hopeless], NO_IMPROVEMENT)
            pending &= ~hopeless
            self.best, self.stagnant = (np.inf, np.inf), 0
        self.pending = int(pending.sum())
        return most - contacts if self.pending else 0


def lane_contacts(scene: Scene, spacing: float) -> tuple[Array, Mapping[int, str]]:
    """Contact points (k, 3), m, `spacing` sensing radii apart on geodesic lanes, and the taxels (by
    id) that cannot be reached, with the reason.
    """
    step = spacing * scene.rig.sensing_radius
    lanes = replace(scene.exploration, pattern="lanes", lane_spacing=step, contacts=None)
    plan = plan_exploration(scene.with_(exploration=lanes))
    unreachable = {k: why for k, why in plan.unreachable.items() if not why.startswith(SPARSE)}
    if plan.contacts is not None:
        return plan.path.points, unreachable
    parts = []
    for segment in plan.segments:
        along = lengths_along(segment.points)
        parts.append(segment.points[np.searchsorted(along, np.arange(0.0, along[-1], step))])
    return np.concatenate(parts), unreachable


def _gaps(scene: Scene, points: Array) -> Array:
    """Contact points (k, 3), m, between those at `points` (m, 3), for taxels without a reading."""
    dense, _ = lane_contacts(scene, SECOND_SPACING)
    distance = cKDTree(points).query(dense)[0]
    return dense[distance > SECOND_SPACING * scene.rig.sensing_radius]


def _without(calibration: Calibration, given_up: Mapping[int, str]) -> Calibration:
    """The calibration with the taxels that are given up unknown, so that none is aimed at."""
    rows = np.isin(calibration.ids, list(given_up))
    poses, observed = calibration.poses.copy(), calibration.observed.copy()
    poses[rows], observed[rows] = np.nan, False
    assert calibration.contact_centroids is not None  # it was calibrated, not loaded
    centroids = calibration.contact_centroids.copy()
    centroids[rows] = np.nan
    return replace(calibration, poses=poses, observed=observed, contact_centroids=centroids)
