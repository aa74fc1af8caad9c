"""What an online calibration tells after each update, and the tests behind its verdict."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from ...core.arrays import Array
from ...core.value import Value
from ..calibration import Calibration
from ..data.delay import late_frames
from ..data.resolve_belief import MAX_INVALID
from ..next_contact import NextTouch
from ..uncertainty.goodness_of_fit import chance
from ..uncertainty.judge import MAX_FAULTY
from .running_estimate import RunningEstimate

KEEP_GOING, DONE = "keep going", "done"
MISFIT, MOVED = "model misfit", "moved since the last calibration"
VERDICTS = KEEP_GOING, DONE, MISFIT, MOVED
"""Verdicts of an online calibration."""
FALSE_ALARM = 1e-3
"""Probability that "model misfit", or "moved since the last calibration", is said at any time of an
exploration, however long, where nothing is wrong; as `goodness_of_fit.SIGNIFICANCE`."""
FIRST_LOOK = 30
"""Degrees of freedom, or contacts, at the first look of a test."""
LOOK_STEP = 1.1
"""Growth of the data from one look to the next: a fault is seen a tenth later than it could be."""
DELAY_CONTACTS, DELAY_STEP, LATEST = 100, 1.5, 500
"""Contacts after which readings are tested for a delay first, their growth from one such look to
the next, and the latest contacts by which it is seen, in 10 ms."""
CONTRADICTED = "most of whose readings contradict all others"
"""Reason of a contact's rejection."""
MIN_COUNT = 20
"""Contacts or taxels from which fractions of them are believed."""
MAX_WAITING_MOVE = 0.1
"""Move since it was estimated anew, in contact radii, up to which a taxel's residuals count."""


class SequentialTest:
    """The level of a test that looks again and again while its data grow.

    Look k has the level FALSE_ALARM / (k (k + 1)); these add up to FALSE_ALARM, whatever the
    dependence between looks (Bonferroni).
    """

    def __init__(self) -> None:
        self.looks, self._next = 0, float(FIRST_LOOK)

    def look(self, count: float) -> float:
        """The level of a look at data of size `count`; 0 where it is not time to look."""
        if count < self._next:
            return 0.0
        self.looks, self._next = self.looks + 1, LOOK_STEP * count
        return FALSE_ALARM / (self.looks * (self.looks + 1))


def moved_taxels(offset: Array, covariance: Array, level: float) -> np.ndarray:
    """Taxels (n,) bool whose offsets (n, 2), m, from their previous places chance does not explain.

    Chi-square with two degrees of freedom under the sum of both covariances (n, 2, 2), m^2, at
    `level` divided by the number of taxels: the probability of any false alarm is at most `level`,
    whatever the dependence between taxels.
    """
    solved = np.linalg.solve(covariance, offset[:, :, None])[..., 0]
    square = np.einsum("ni,ni->n", offset, solved)
    return np.asarray(np.exp(-square / 2) < level / max(len(offset), 1))


@dataclass(frozen=True, eq=False)
class OnlineStatus(Value):
    """The state of an online calibration after an update. SI units."""

    used: int = 0
    """Contacts whose readings count."""
    rejected: int = 0
    """Contacts left out: not finite, off the body, outside the contact model's range, or with
    readings most of which contradict all others."""
    outlying: int = 0
    """Readings of the contacts used that are left out as outlying."""
    determined: int = 0
    """Taxels whose place the readings determine."""
    weak: int = 0
    """Taxels that were read, but whose place is not determined, or not unique."""
    unseen: int = 0
    """Taxels without a reading above five standard deviations of the noise."""
    median_sigma: float = np.nan
    """Median standard deviation, m, of the determined taxels' positions; NaN without any."""
    worst_sigma: float = np.nan
    """The largest, m; NaN without any."""
    unknowns: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Global parameters: value and standard deviation, as `Calibration.unknowns`."""
    undetermined: tuple[str, ...] = ()
    """Directions of the global parameters that rest on the priors, in words."""
    next_touch: NextTouch | None = None
    """Where a contact reduces the largest uncertainties most; None where none of the taxels with
    readings needs one, or none was read. It is computed again every NEXT_TOUCH_EVERY frames."""
    verdict: str = KEEP_GOING
    """One of VERDICTS."""
    why: str = ""
    """The reason of the verdict, in words."""
    residual: float = np.nan
    """Root mean square of the residuals of the last readings, in standard deviations of noise and
    estimate together; NaN before the first reading of a placed taxel."""
    moved: tuple[int, ...] = ()
    """Ids of the taxels that moved since the last calibration."""
    waiting: int = 0
    """Taxels that wait for being estimated anew; `OnlineCalibration.settle` empties the queue."""

    def __str__(self) -> str:
        sigma = "no position yet"
        if np.isfinite(self.median_sigma):
            sigma = (
                f"sigma {1e3 * self.median_sigma:.3g} mm, at most {1e3 * self.worst_sigma:.3g} mm"
            )
        return (
            f"{self.verdict}: {self.used} contacts ({self.rejected} rejected), "
            f"{self.determined} taxels determined, {self.weak} weak, {self.unseen} unseen; {sigma}"
        )


class Judge:
    """Looks at a running estimate as it grows, and says whether to go on."""

    def __init__(
        self, ids: np.ndarray, previous: Calibration | None, reachable: np.ndarray, target: float
    ) -> None:
        """ids (n,): of the taxels; reachable (n,) bool: those that count; target: standard
        deviation, m, that is asked for."""
        self.reachable, self.target = reachable, target
        self.misfit = ""
        """Why the model misfits, in words; "" where it does not."""
        self.moved = np.zeros(len(ids), dtype=bool)
        """Taxels (n,) that are elsewhere than before."""
        self.late = 0
        """Frames by which the readings come too late; negative: too early."""
        self._delay_at = DELAY_CONTACTS
        self._fit_test, self._move_test = SequentialTest(), SequentialTest()
        self._before: tuple[Array, Array] | None = None
        if previous is not None:
            place = {int(k): j for j, k in enumerate(previous.ids)}
            rows = np.array([place.get(int(k), -1) for k in ids])
            turn = previous.poses[rows, :3, :3]
            covariance = turn @ previous.covariances[rows, :3, :3] @ np.swapaxes(turn, 1, 2)
            points = np.where((rows >= 0)[:, None], previous.positions[rows], np.nan)
            self._before = points, covariance

    def look(self, estimate: RunningEstimate, rejected: Counter[str]) -> None:
        """Test delay, fit and moves, where it is time to; rejected: numbers of the contacts that
        were left out before, by reason."""
        self._look_for_delay(estimate)
        self._look_at_fit(estimate, rejected)
        self._look_for_moves(estimate)

    def verdict(self, sigma: Array, seen: np.ndarray) -> tuple[str, str]:
        """The verdict and its reason; sigma (n,): standard deviations, m, inf where not determined;
        seen (n,) bool: taxels with readings."""
        if self.late:
            words = f"{abs(self.late)} frames too {'late' if self.late > 0 else 'early'}"
            return MISFIT, f"the readings come {words}, which ms.calibrate corrects"
        if self.misfit:
            return MISFIT, self.misfit
        if self.moved.any():
            return MOVED, f"{self.moved.sum()} taxels are elsewhere"
        above = self.reachable & (sigma > self.target)
        if not above.any():
            return DONE, f"every reachable taxel is known to {1e3 * self.target:.3g} mm"
        unseen = int(np.sum(above & ~seen))
        words = f"{above.sum() - unseen} taxels are above the target, {unseen} were never read"
        return KEEP_GOING, words

    def _look_for_delay(self, estimate: RunningEstimate) -> None:
        store, drags = estimate.store, "drag" in estimate.parameters.names  # which looks alike
        if store.count < self._delay_at or store.template.learned or drags:
            return
        self._delay_at = int(DELAY_STEP * store.count)
        self.late = late_frames(store.latest(LATEST))
        estimate.misfit = bool(self.misfit or self.late)

    def _look_at_fit(self, estimate: RunningEstimate, rejected: Counter[str]) -> None:
        contacts = rejected.total() + estimate.store.count
        if not (level := self._fit_test.look(contacts)):  # however few of them count
            return
        placed, pairs = estimate.information.placed, estimate.store.template.noise_pairs
        # one whose contacts all lie to one side may be on the wrong side of them
        used = estimate.sure & (estimate.moved < MAX_WAITING_MOVE)
        square = float(estimate.square[used].sum())
        freedom = float(estimate.freedom[used].sum()) - len(estimate.parameters.sigma)
        unfit = int(np.sum(placed & ~estimate.fits))
        rejected = rejected + Counter({CONTRADICTED: int(estimate.store.misfitting.values.sum())})
        known = not estimate.store.noise_is_nominal and freedom >= FIRST_LOOK
        self.misfit = ""
        if known and chance(square, freedom, pairs) < level:
            self.misfit = f"residuals are {np.sqrt(square / freedom):.3g} times the noise"
        elif contacts >= MIN_COUNT and rejected.total() > MAX_INVALID * contacts:
            ((reason, count),) = rejected.most_common(1)
            total = rejected.total()
            of_these = "" if count == total else f"{count} of these "
            self.misfit = f"{total} of {contacts} contacts are rejected, {of_these}{reason}"
        elif placed.sum() >= MIN_COUNT and unfit > MAX_FAULTY * placed.sum():
            self.misfit = f"the readings of {unfit} of {placed.sum()} taxels do not fit"
        estimate.misfit = bool(self.misfit or self.late)

    def _look_for_moves(self, estimate: RunningEstimate) -> None:
        if self._before is None or not (level := self._move_test.look(estimate.store.count)):
            return
        info, (points, covariance) = estimate.information, self._before
        compared = estimate.determined & np.isfinite(points[:, 0])
        rows = np.flatnonzero(compared & np.isfinite(covariance).all(axis=(1, 2)))
        tangents = info.charts.tangents[rows]
        offset = np.einsum("nij,ni->nj", tangents, info.points(rows) - points[rows])
        both = np.swapaxes(tangents, 1, 2) @ covariance[rows] @ tangents
        self.moved[:] = False
        self.moved[rows] = moved_taxels(offset, both + estimate.covariances[rows], level)
