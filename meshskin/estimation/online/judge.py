"""The verdict of an online calibration: tests of the fit and of moves, and the target."""

from __future__ import annotations

import numpy as np

from ...core.arrays import Array
from ..calibration import Calibration
from ..data.resolve_belief import MAX_INVALID
from ..uncertainty.judge import MAX_FAULTY
from .running_estimate import RunningEstimate
from .status import DONE, KEEP_GOING, MISFIT, MOVED, SequentialTest, misfits, moved_taxels

MIN_COUNT = 20
"""Contacts or taxels from which fractions of them are believed."""
MAX_WAITING_MOVE = 0.1
"""Move since it was estimated anew, in contact radii, up to which a taxel's residuals count."""


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
        self._fit_test, self._move_test = SequentialTest(), SequentialTest()
        self._before: tuple[Array, Array] | None = None
        if previous is not None:
            place = {int(k): j for j, k in enumerate(previous.ids)}
            rows = np.array([place.get(int(k), -1) for k in ids])
            turn = previous.poses[rows, :3, :3]
            covariance = turn @ previous.covariances[rows, :3, :3] @ np.swapaxes(turn, 1, 2)
            points = np.where((rows >= 0)[:, None], previous.positions[rows], np.nan)
            self._before = points, covariance

    def look(self, estimate: RunningEstimate, rejected: int) -> None:
        """Test fit and moves, where it is time to; rejected: contacts that were left out before."""
        self._look_at_fit(estimate, rejected)
        self._look_for_moves(estimate)

    def verdict(self, sigma: Array, seen: np.ndarray) -> tuple[str, str]:
        """The verdict and its reason; sigma (n,): standard deviations, m, inf where not determined;
        seen (n,) bool: taxels with readings."""
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

    def _look_at_fit(self, estimate: RunningEstimate, rejected: int) -> None:
        placed = estimate.information.placed
        used = placed & estimate.fits & (estimate.moved < MAX_WAITING_MOVE)
        square = float(estimate.square[used].sum())
        freedom = float(estimate.freedom[used].sum()) - len(estimate.parameters.sigma)
        if not (level := self._fit_test.look(freedom)):
            return
        unfit = int(np.sum(placed & ~estimate.fits))
        contacts = rejected + estimate.store.count
        rejected += int(estimate.store.misfitting.values.sum())
        self.misfit = ""
        pairs = estimate.store.template.noise_pairs
        if not estimate.store.noise_is_nominal and misfits(square, freedom, level, pairs):
            self.misfit = f"residuals are {np.sqrt(square / freedom):.3g} times the noise"
        elif contacts >= MIN_COUNT and rejected > MAX_INVALID * contacts:
            self.misfit = f"{rejected} of {contacts} contacts are rejected"
        elif placed.sum() >= MIN_COUNT and unfit > MAX_FAULTY * placed.sum():
            self.misfit = f"the readings of {unfit} of {placed.sum()} taxels do not fit"
        estimate.misfit = bool(self.misfit)

    def _look_for_moves(self, estimate: RunningEstimate) -> None:
        if self._before is None or not (level := self._move_test.look(estimate.store.count)):
            return
        info, (points, covariance) = estimate.information, self._before
        tangents = info.charts.tangents
        compared = estimate.determined & np.isfinite(points[:, 0])
        compared &= np.isfinite(covariance).all(axis=(1, 2))
        rows = np.flatnonzero(compared)
        offset = np.full((len(compared), 2), np.nan)
        offset[rows] = np.einsum("nij,ni->nj", tangents[rows], info.points(rows) - points[rows])
        both = np.full((len(compared), 2, 2), np.inf)
        both[rows] = np.swapaxes(tangents[rows], 1, 2) @ covariance[rows] @ tangents[rows]
        both[rows] += estimate.covariances[rows]
        self.moved = moved_taxels(offset, both, level)
