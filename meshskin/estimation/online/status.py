"""What an online calibration tells after each update, and the tests behind its verdict."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...core.arrays import Array
from ...core.value import Value
from .next_touch import NextTouch

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


def misfits(square: float, freedom: float, level: float, pairs: int = 0) -> bool:
    """Whether the sum of squared residuals with `freedom` degrees is above chance at `level`.

    pairs: of readings that their unit, the noise, was estimated from; 0: it is known."""
    from scipy.special import chdtrc, fdtrc

    if pairs:
        return bool(fdtrc(freedom, pairs, square / freedom) < level)
    return bool(chdtrc(freedom, square) < level)


def moved_taxels(offset: Array, covariance: Array, level: float) -> np.ndarray:
    """Taxels (n,) bool whose offsets (n, 2), m, from their previous places chance does not explain.

    Chi-square with two degrees of freedom under the sum of both covariances (n, 2, 2), m^2, at
    `level` divided by the number of taxels compared: the probability of any false alarm is at most
    `level`, whatever the dependence between taxels. NaN where a taxel cannot be compared.
    """
    known = np.isfinite(offset[:, 0]) & np.isfinite(covariance).all(axis=(1, 2))
    out = np.zeros(len(offset), dtype=bool)
    if known.any():
        solved = np.linalg.solve(covariance[known], offset[known, :, None])[..., 0]
        square = np.einsum("ni,ni->n", offset[known], solved)
        out[known] = np.exp(-square / 2) < level / known.sum()
    return out


@dataclass(frozen=True, eq=False)
class OnlineStatus(Value):
    """The state of an online calibration after an update. SI units."""

    used: int
    """Contacts whose readings count."""
    rejected: int
    """Contacts left out: not finite, off the body, outside the contact model's range, or with
    readings most of which contradict all others."""
    outlying: int
    """Readings of the contacts used that are left out as outlying."""
    determined: int
    """Taxels whose place the readings determine."""
    weak: int
    """Taxels that were read, but whose place is not determined, or not unique."""
    unseen: int
    """Taxels that no contact has been read by."""
    median_sigma: float
    """Median standard deviation, m, of the determined taxels' positions; NaN without any."""
    worst_sigma: float
    """The largest, m; NaN without any."""
    unknowns: dict[str, tuple[float, float]]
    """Global parameters: value and standard deviation, as `Calibration.unknowns`."""
    undetermined: tuple[str, ...]
    """Directions of the global parameters that rest on the priors, in words."""
    next_touch: NextTouch | None
    """Where a contact reduces the largest uncertainties most; None where none of the taxels with
    readings needs one, or none was read. It is computed again every NEXT_TOUCH_EVERY frames."""
    verdict: str
    """One of VERDICTS."""
    why: str
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
