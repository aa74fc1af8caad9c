"""Calibration while contacts come in: `OnlineCalibration`."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_array, check_real, check_type
from ...core.arrays import Array
from ...core.errors import CalibrationError, RecordingError
from ...recording.recording import Recording
from ...scene.belief import Belief
from .. import chart
from ..calibration import Calibration
from ..joint.null_space import undetermined
from ..next_contact import NextTouch, next_touch
from ..recalibrate.result import Recalibration
from ..uncertainty.observability import pose_covariance
from .frames import ContactFrames, RecordedFrames, checked_belief, sparse
from .intake import SETTLED_CHANGE, Intake
from .running_estimate import RunningEstimate
from .settling import RunningNoise, settle
from .status import Judge, OnlineStatus

PERIOD = 0.02
"""Time from frame to frame, s, where none is given: 50 frames a second."""
FRAMES = 10
"""Frames that are added at once: within them estimates are linearized where they were before."""
ANEW = 3
"""Taxels that are estimated anew at once, one half in each of two frames, so that none takes long
(studies/speed/online.py)."""
EXAMINE_EVERY = 3
"""Frames after which one looks for other places of taxels with an open sector, for 4 ms."""
NEXT_TOUCH_EVERY = 10
"""Frames after which the next touch is computed again: five times a second at 50 frames."""


class OnlineCalibration:
    """Positions of n taxels while contacts come in: each update takes new frames and tells how far
    the calibration is.

        online = ms.OnlineCalibration(belief, target_sigma=0.1e-3)
        while online.update(contacts, readings).verdict == "keep going":
            contacts, readings = ...  # the next frames; touch at online.status.next_touch.point

    It has the joint estimator's model, unknowns and priors. Each taxel keeps the information of its
    readings, linearized at its estimate; taxels that moved are estimated anew from all their
    readings, a few in every frame. Where none waits for it (`status.waiting`), estimates are those
    of `calibrate` on the same contacts, to 1 % of a standard deviation; updates without frames go
    on with those that wait, `settle` estimates them all at once. Silent readings are censored at
    the threshold; outlying readings are left out and counted.

    Verdicts, and the probability of a false alarm at any time of an exploration:
    - "model misfit": a chi-square test of the residuals (1e-3 in all, over all looks), or more than
      5 % of the contacts rejected, or more than 20 % of the taxels misfitting, or readings that
      come some frames late (1e-3 at each look, from 100 contacts on), which only `calibrate`
      corrects. Covariances are multiplied by the variance of the residuals then.
    - "moved since the last calibration": a taxel is elsewhere than in `previous`, by more than both
      uncertainties allow (1e-3 in all, over all looks and taxels).
    - "done": every taxel but the `unreachable` is determined, to `target_sigma`.
    - "keep going": none of these.
    """

    def __init__(
        self,
        belief: Belief,
        previous: Calibration | Recalibration | None = None,
        *,
        target_sigma: float = 1e-4,
        unreachable: Collection[int] = (),
    ) -> None:
        """previous: an earlier calibration of the skin: which taxels moved is tested against it,
        and its noise serves where the belief has none; its positions are not used. Where neither
        has a noise, it is estimated, from the first hundreds of contacts on. target_sigma:
        standard deviation, m, of a position (root of the trace) that is asked for. unreachable: ids
        of taxels that cannot be touched.

        Raises CalibrationError for beliefs that only `calibrate` can use: learned or raw readings,
        rigid modules, a contact motion; and for a `previous` of another type.
        """
        if isinstance(previous, Recalibration):
            previous = previous.calibration
        if previous is not None:
            check_type(Calibration, previous, "the previous calibration")
        self.belief = checked_belief(belief, previous)
        self.previous, self.target = previous, check_real("target_sigma", target_sigma, above=0.0)
        self.ids = np.asarray(belief.taxel_ids)
        """Taxel ids (n,), in the belief's order."""
        unknown = set(unreachable) - set(self.ids.tolist())
        if unknown:
            raise CalibrationError("unreachable: no ids of the skin", value=sorted(unknown)[:5])
        reachable = ~np.isin(self.ids, list(unreachable))
        self.frames = 0
        self.status: OnlineStatus | None = None
        """Status after the last update; None before the first."""
        self.estimate: RunningEstimate | None = None
        """The running estimate; None before the first contact."""
        self._intake = Intake(self.belief)
        self._judge = Judge(self.ids, previous, reachable, self.target)
        self._noise = RunningNoise(self.belief.noise_sigma is not None)
        self._next: NextTouch | None = None
        self._turn, self._touch_at = 0, NEXT_TOUCH_EVERY

    def __repr__(self) -> str:
        return f"<OnlineCalibration of {len(self.ids)} taxels: {self.status or 'no contacts yet'}>"

    def update(self, contacts: ContactFrames, readings: ArrayLike) -> OnlineStatus:
        """Add B frames; readings (B, n), or (n,) of one frame: of the taxels in the belief's order,
        in Pa. A reading up to the threshold says that the taxel is silent, NaN that it is lost.

        Frames without force are not contacts; with no frames, taxels that wait are estimated anew.
        Raises RecordingError for readings of another shape, CalibrationError for the first contacts
        far from the body, and headings that lack.
        """
        check_type(ContactFrames, contacts, "contacts of an update")
        values = check_array("readings of an update", readings, error=RecordingError)
        wide = values.shape[-1] if values.ndim and values.size else len(self.ids)
        values = values.reshape(-1, wide)
        if values.shape != (len(contacts), len(self.ids)):
            raise RecordingError(
                "an update needs a reading of every taxel in every frame",
                value=f"shape {values.shape}",
                limit=f"({len(contacts)}, {len(self.ids)})",
            )
        for begin in range(0, len(contacts), FRAMES):
            rows = slice(begin, begin + FRAMES)
            self._take(contacts.take(rows), values[rows])
        if not len(contacts):
            self._advance(1, self._complete())
        return self._tell()

    def update_recording(self, recording: Recording) -> OnlineStatus:
        """Add the contacts of a recording, or of a part of one, with their readings."""
        parts = RecordedFrames(recording, self.ids)
        if self.estimate is None:
            self.estimate = self._intake.start(ContactFrames(recording.points, recording.force))
        for begin in range(0, len(recording.time), FRAMES):
            self._take(*parts.part(begin, begin + FRAMES))
        if self.estimate is not None:
            self._intake.look(self.estimate)
        return self._tell()

    def settle(self) -> OnlineStatus:
        """Estimate anew all taxels that wait for it, in a time that is not bounded."""
        self._started.complete()
        self._intake.look(self._started, SETTLED_CHANGE)
        settle(self._started)
        self._noise.settle(self._started)
        self._judge.look(self._started, self._intake.rejected)
        return self._tell()

    @property
    def positions(self) -> Array:
        """Positions (n, 3), body frame, m; NaN where not determined."""
        determined = np.isfinite(self.position_sigma)
        return np.where(determined[:, None], self.provisional, np.nan)

    @property
    def provisional(self) -> Array:
        """Positions (n, 3), m, of weak taxels, too: the present estimate, or the mean contact point
        weighted by pressure squared; NaN where unseen. For pictures, not for use."""
        if self.estimate is None:
            return np.full((len(self.ids), 3), np.nan)
        info = self.estimate.information
        points = info.points(np.arange(len(self.ids)))
        near = info.placed & (self.estimate.moved < 0.5)
        return np.where(near[:, None], points, self.estimate.store.means)

    @property
    def poses(self) -> Array:
        """T_body_taxel (n, 4, 4), as `Calibration.poses`; NaN where not determined."""
        if self.estimate is None:
            return np.full((len(self.ids), 4, 4), np.nan)
        return chart.poses(self.positions, self.estimate.information.charts.rotations)

    @property
    def covariances(self) -> Array:
        """(n, 6, 6) in the taxels' frames, translation first, as `Calibration.covariances`, without
        what the contact points show of errors of the body; inf where not determined."""
        flat = np.tile(np.diag([np.inf, np.inf]), (len(self.ids), 1, 1))
        shape = np.zeros_like(flat)
        if self.estimate is not None:
            known = self.estimate.determined[:, None, None]
            flat = np.where(known, self.estimate.covariances, flat)
            shape = self.estimate.information.charts.shape
        return pose_covariance(flat, shape)

    @property
    def position_sigma(self) -> Array:
        """Standard deviation (n,), m, of the position (root of the trace); inf where not
        determined."""
        if self.estimate is None:
            return np.full(len(self.ids), np.inf)
        trace = np.trace(self.estimate.covariances, axis1=1, axis2=2)
        return np.where(self.estimate.determined, np.sqrt(np.maximum(trace, 0.0)), np.inf)

    def recording(self) -> Recording:
        """The contacts used so far, with their readings: `save` keeps them, and
        `update_recording` of another `OnlineCalibration` goes on from there. Times that do not
        rise, of several recordings, are replaced by those of 50 frames a second."""
        table, readings = self._started.store.tables(self.ids, PERIOD)
        metadata = {"taxel_ids": self.ids.tolist(), "disc_radius_m": self.belief.disc_radius}
        return Recording(table, readings, metadata)

    def calibration(self) -> Calibration:
        """The calibration of all contacts so far by `calibrate`, started from these estimates.

        Raises as `calibrate`.
        """
        from ..calibrate import Estimation

        estimation = Estimation(self.recording(), self.belief, start=self.positions)
        return estimation.calibrate()

    def _take(self, frames: ContactFrames, values: Array) -> None:
        """Add at most FRAMES frames, and do the work that is due; values (B, n): readings, Pa."""
        completed, number = self._complete(), self.frames
        if frames.time is None:
            times = np.arange(number, number + len(frames), dtype=float)
            frames = replace(frames, time=PERIOD * times)
        self.frames += len(frames)
        readings = sparse(values, self.belief.threshold)
        self.estimate = self._intake.take(self.estimate, frames, number, readings)
        self._advance(len(frames), completed)

    def _complete(self) -> bool:
        """Complete the estimate that the last frame began; whether there was one."""
        return self.estimate is not None and self.estimate.complete()

    def _advance(self, frames: int, completed: bool) -> None:
        """The bounded work of so many frames: of one frame, one of what there is to do, unless it
        `completed` what the last one began."""
        if self.estimate is None:
            return
        estimate = self.estimate
        self._turn += frames
        estimate.solve()
        self._noise.look(estimate)
        if frames > 1:
            estimate.examine(frames)
            estimate.estimate_anew(estimate.waiting()[: ANEW * frames])
        if self._turn >= self._touch_at and not completed:
            self._touch_at = self._turn + NEXT_TOUCH_EVERY
            self._next = self._best_touch()
        elif frames == 1 and not completed:
            if self._turn % EXAMINE_EVERY == 0 and estimate.examining:
                estimate.examine(1)
            else:
                estimate.begin(estimate.waiting()[:ANEW])
        self._judge.look(estimate, self._intake.rejected)

    @property
    def _started(self) -> RunningEstimate:
        if self.estimate is None:
            raise CalibrationError("no contact so far", remedy="update with contacts first")
        return self.estimate

    def _best_touch(self) -> NextTouch | None:
        estimate, belief = self._started, self._started.store.template.belief
        seen = self._judge.reachable & (estimate.store.counts > 0)
        sigma = self.position_sigma
        seen[seen] = np.isfinite(self.provisional[seen, 0])
        if not (sigma[seen] > self.target).any():
            return None
        rows = np.flatnonzero(seen)
        tangents, known = estimate.information.charts.tangents, np.isfinite(sigma)
        reach = (estimate.radius + belief.disc_radius) ** 2 / 2
        spatial = np.tile(reach * np.eye(3), (len(self.ids), 1, 1))
        spatial[known] = (
            tangents[known] @ estimate.covariances[known] @ np.swapaxes(tangents[known], 1, 2)
        )
        template = estimate.store.template
        modulus = template.modulus * float(np.exp(template.parameters.value("modulus", estimate.s)))
        return next_touch(
            self.ids[rows], self.provisional[rows], spatial[rows], belief, modulus, estimate.radius
        )

    def _tell(self) -> OnlineStatus:
        n = len(self.ids)
        rejected = self._intake.rejected.total()
        if self.estimate is None:
            self.status = OnlineStatus(rejected=rejected, unseen=n, why="no contact so far")
            return self.status
        estimate, info = self.estimate, self.estimate.information
        determined, sigma = estimate.determined, self.position_sigma
        seen, (information, gains) = estimate.store.counts > 0, info.of_shared
        variance = estimate.scale**2 if estimate.misfit else 1.0
        contradicting = int(estimate.store.misfitting.values.sum())
        verdict, why = self._judge.verdict(sigma, seen)
        self.status = OnlineStatus(
            used=estimate.store.count - contradicting,
            rejected=rejected + contradicting,
            outlying=int(estimate.outlying.sum()),
            determined=int(determined.sum()),
            weak=int(np.sum(seen & ~determined)),
            unseen=int(np.sum(~seen)),
            median_sigma=float(np.median(sigma[determined])) if determined.any() else np.nan,
            worst_sigma=float(sigma[determined].max(initial=0.0)) if determined.any() else np.nan,
            unknowns=estimate.parameters.named(info.s, variance * info.s_covariance),
            undetermined=undetermined(estimate.parameters, information, gains),
            next_touch=self._next,
            verdict=verdict,
            why=why,
            residual=estimate.residual,
            moved=tuple(self.ids[self._judge.moved].tolist()),
            waiting=len(estimate.waiting()) + len(estimate.unexamined()),
        )
        return self.status
