"""From a recording and a belief to a calibration, by any of the estimators."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property, partial

import numpy as np

from ..contact import AUTO, LEARNED
from ..core.arguments import check_integer, check_name, check_real, check_type
from ..core.arrays import Array
from ..core.blas import single_threaded
from ..core.errors import CalibrationError, ConfigError, ContactError, warn_left_out
from ..core.progress import Progress, Stage
from ..recording.recording import Recording
from ..scene.belief import RAW, Belief
from . import centroid, chart
from .calibration import Calibration, provenance_of
from .data.gather import gather, gather_or_learn
from .data.measurements import Measurements
from .data.patch_shape import MAX_EDGES
from .data.raw_readings import DENSE
from .joint import maximum_likelihood
from .joint.departures import MIN_SCORE
from .joint.optimum import Optimum
from .joint.reduced_nlp import MAX_ITERATIONS, NEWTON_TOLERANCE
from .layout import estimate as layout
from .learned import estimate as learned
from .learned.start import Former
from .result import EstimatorResult
from .trilateration import coactivation, eq15, trilaterate
from .trilateration.displacements import Displacements, SharedContacts, Trilateration
from .uncalibrated import uncalibrated
from .uncertainty import observability, weighted_means
from .uncertainty.contact_errors import systematic_covariance
from .uncertainty.judge import fails_by_itself, judge
from .uncertainty.second_places import SecondPlaces
from .uncertainty.unseen_motions import unseen_motions

UNTOUCHED = "never touched"
CONSTANT = "its reading never changes"
WEAK = "too weakly determined"
UNITLESS = ("joint", "centroid")
"""Methods that take readings in a unit of their own; the others read distances off pressures."""
MIN_DRAWN = 240
"""Taxels, at least, whose errors are drawn to measure the correlation of displacements: the mean
square that scales the covariance is then known to about 2 / sqrt(2 * 240) = 9 %."""


class Estimation:
    """The estimators on one recording under one belief; what they share is computed once."""

    def __init__(
        self, recording: Recording, belief: Belief,
        start: Array | None = None, former: Former | None = None,
    ) -> None:  # fmt: skip
        """start: positions (n, 3), m, at which the joint estimate begins, NaN where not known;
        former: another Estimation's `last`, to begin a learned response. Raises as `calibrate`."""
        begin = time.perf_counter()
        check_type(Recording, recording, "what is calibrated")
        if not hasattr(belief, "taxel_ids"):
            remedy = "give what the robot's owner knows: scene.belief()"
            raise CalibrationError("no belief", value=type(belief).__name__, remedy=remedy)
        self.data, self._out_of_range = gather_or_learn(recording, belief)
        self.recording, self.belief, self.start, self._former = recording, belief, start, former
        self.last: Former | None = None  # the estimate by `calibrate`, if its response is learned
        self._displacements: dict[Trilateration, Displacements] = {}
        self._seconds = time.perf_counter() - begin

    @single_threaded()
    def calibrate(
        self,
        method: str = "joint",
        tolerance: float = NEWTON_TOLERANCE,
        iterations: int = MAX_ITERATIONS,
        progress: Progress | None = None,
    ) -> Calibration:
        """The calibration by a method; arguments and errors as `calibrate`."""
        stage = Stage(progress, "calibrate", maximum_likelihood.USUAL_STEPS)
        found, result = self._estimated(method, tolerance, iterations, stage=stage)
        self.last = result.former
        begin, places = time.perf_counter(), SecondPlaces(self.data, found)
        found = weighted_means.widened(self._near, places.widened(), result.departures)
        verdict = judge(self.recording, self._near, found, result.departures, places.findings())
        stage.end()
        judged = time.perf_counter() - begin
        more = {name: found.seconds[name] + judged for name in ("other", "total")}
        return replace(found, verdict=verdict, seconds={**found.seconds, **more})

    @single_threaded()
    def without_verdict(self, method: str, progress: Progress | None) -> Calibration:
        """The calibration by a method, for comparison with others; errors as `calibrate`."""
        return self._estimated(method, stage=Stage(progress, "calibrate"))[0]

    def _estimated(
        self,
        method: str,
        tolerance: float = NEWTON_TOLERANCE,
        iterations: int = MAX_ITERATIONS,
        *,
        stage: Stage,
    ) -> tuple[Calibration, EstimatorResult]:
        """The calibration by a method, without a verdict, and the estimate that it is made of."""
        limits = self._limits(method, tolerance, iterations)
        begin, data = time.perf_counter(), self.data
        result = METHODS[method](self, stage, **limits)
        shape = observability.shape_operators(data.body, result.points, result.rotations)
        covariance = result.pose_covariances
        if covariance is None:
            covariance = observability.pose_covariance(result.covariance, shape)
        observed = observability.degrees_of_freedom(covariance, float(np.median(data.radii)))
        covariance = covariance + systematic_covariance(
            self._near, result.unknowns, result.points, result.rotations, shape, result.jump
        )
        weak = np.asarray(~observed.any(axis=1))
        points = np.where(weak[:, None], np.nan, result.points)
        calibration = Calibration(
            ids=data.ids,
            poses=chart.poses(points, result.rotations),
            covariances=np.where(weak[:, None, None], np.diag([np.inf] * 6), covariance),
            observed=observed,
            touched=data.counts > 0,
            readings=data.counts,
            method=method,
            chi2=result.chi2,
            reasons=self._reasons(result, weak),
            contact_centroids=self._contact_centroids,
            belief=data.belief,
            provenance=provenance_of(method, self.recording),
            disc_radius=data.belief.disc_radius,
            frame=getattr(data.belief.body, "frame", None),  # an exact surface has none
            **{**result.details, "undetermined": result.undetermined + unseen_motions(self._near)},
        )
        seconds = {"gather": self._seconds, **result.seconds}
        total = self._seconds + time.perf_counter() - begin
        seconds |= {"other": total - sum(seconds.values()), "total": total}
        return replace(calibration, seconds=seconds), result

    def _limits(self, method: str, tolerance: float, iterations: int) -> dict[str, float]:
        """The limits that a method takes. Raises as `calibrate` for arguments that do not fit."""
        check_name("method", method, tuple(METHODS))
        check_real("tolerance of a calibration", tolerance, above=0.0)
        iterations = check_integer("limit of iterations", iterations, least=1)
        unknown_scale = 'readings="raw"' if self.belief.readings == RAW else self._out_of_range
        if unknown_scale and method not in UNITLESS:
            raise CalibrationError(
                f"the method {method} needs pressures of a contact model", value=unknown_scale,
                remedy=f"use one of {', '.join(UNITLESS)}",
            )  # fmt: skip
        usual = (tolerance, iterations) == (NEWTON_TOLERANCE, MAX_ITERATIONS)
        if not usual and (self.data.learned or method != "joint"):
            raise ConfigError(
                "tolerance and iterations are for the joint estimate under a contact model",
                value=f"the method {method}" + " with a learned response" * self.data.learned,
            )
        return {"tolerance": tolerance, "iterations": iterations} if method == "joint" else {}

    def _reasons(self, result: EstimatorResult, weak: np.ndarray) -> np.ndarray:
        """Why a taxel (n,) has no estimate; weak (n,): those too weakly determined."""
        reasons = np.array(result.reasons, dtype=object)
        reasons[(self.data.counts == 0) & (reasons != "")] = UNTOUCHED
        reasons[weak & (reasons == "")] = WEAK
        reasons[self.data.constant & (reasons != "")] = CONSTANT
        return reasons

    @cached_property
    def _near(self) -> Measurements:
        """The readings without distant ones, if taxels are recorded at rest, too."""
        data = self.data
        at_rest = np.any(data.counts > DENSE * len(data.points))
        return coactivation.without_distant_readings(data) if at_rest else data

    @cached_property
    def _contact_centroids(self) -> Array:
        return trilaterate.centroids(coactivation.without_distant_readings(self.data))

    def joint(
        self, stage: Stage, tolerance: float = NEWTON_TOLERANCE, iterations: int = MAX_ITERATIONS
    ) -> EstimatorResult:
        """Maximum likelihood over all readings; arguments as `calibrate`.

        The response is learned where the belief asks for it, or leaves the contact model open and
        no model holds, the readings contradict it, or lead to no estimate; but for a log that
        fails by itself, which no response mends.
        """
        if self.data.learned:
            return learned.estimate(self.data, stage, self._former)
        try:
            found = maximum_likelihood.optimum(
                self.data, self._initial, iterations, tolerance, self.least_squares, stage
            )
        except CalibrationError:
            if (other := self._learned(stage)) is None:
                raise
            return other
        if self._contradicted(found) and not fails_by_itself(self.recording, self.data):
            return found.found.with_jump(self._learned(stage)) or found.result()
        return found.result()

    @property
    def _initial(self) -> EstimatorResult | None:
        """The positions at which the joint estimate begins; None: it finds them."""
        if self.start is None:
            return None
        near = coactivation.without_distant_readings(self.data)
        fit = self.least_squares if near is self.data else trilaterate.least_squares(near)
        found = coactivation.initial_estimate(near, fit)
        known = np.asarray(np.isfinite(self.start).all(axis=1))
        points = np.where(known[:, None], self.start, found.points)
        return replace(found, points=points, reasons=np.where(known, "", found.reasons))

    def _contradicted(self, found: Optimum) -> bool:
        """Whether the readings contradict the contact model, or cannot, over edges of the body."""
        if self.data.edges > MAX_EDGES * len(self.data.points):
            return True
        if found.fit.of_computing(self.data.pressure):
            return False
        # scatter of few contacts may hide more than gains that only the readings ask for
        misfits = found.fit.good is False or found.undeclared_gains
        return misfits or max(found.departures.values(), default=0.0) > MIN_SCORE

    def _learned(self, stage: Stage) -> EstimatorResult | None:
        """The estimate with a learned response, if the contact model was chosen by "auto"; None
        where it was not, where the indenter does not fit most contacts, or where that estimate does
        not converge."""
        if self.belief.contact != AUTO:
            return None
        try:
            data = gather(self.recording, replace(self.belief, contact=LEARNED))
            return learned.estimate(data, stage, self._former)
        except (CalibrationError, ContactError):
            return None

    @cached_property
    def least_squares(self) -> EstimatorResult:
        """Trilateration by least squares over all circles of each taxel."""
        return trilaterate.least_squares(self._circled)

    @cached_property
    def _circled(self) -> Measurements:
        return trilaterate.with_noise_off_edges(self.data)

    def _scaled(self, fit: EstimatorResult) -> EstimatorResult:
        """A trilateration with covariances scaled by its residuals where the noise is unknown."""
        trilaterate.require_any(fit)
        scale = 1.0 if self._circled.noise is not None else float(np.nanmedian(fit.chi2))
        return replace(fit, covariance=fit.covariance * (scale if np.isfinite(scale) else 1.0))

    @cached_property
    def _shared_contacts(self) -> SharedContacts:
        return SharedContacts(self._circled, trilaterate.require_any(self.least_squares))

    def _measured(self, stage: Stage, trilateration: Trilateration) -> Displacements:
        """The displacements by a trilateration of both taxels of each pair."""
        if trilateration not in self._displacements:
            shared = self._shared_contacts
            draws = -(-MIN_DRAWN // int(self.least_squares.found.sum()))
            self._displacements[trilateration] = shared.displacements(trilateration, draws, stage)
        return self._displacements[trilateration]

    def posegraph(
        self,
        stage: Stage,
        isotropic: bool = False,
        trilateration: Trilateration = trilaterate.solve,
    ) -> EstimatorResult:
        """The pose graph of the displacements between co-active taxels; arguments as
        `Displacements.graph` and `SharedContacts.displacements`.
        """
        from .uncertainty import gauge

        begin = time.perf_counter()
        measured, fit = self._measured(stage, trilateration), self.least_squares
        graph = measured.graph(fit, self.data.ids, isotropic)
        prepared = time.perf_counter() - begin
        stage.step()
        solution = graph.solve(keep_iterates=True, progress=lambda *_: stage.step())
        stage.step()
        information = "isotropic" if isotropic else "full"
        return gauge.aligned_estimate(graph, solution, fit, measured.errors, information, prepared)


METHODS: dict[str, Callable[..., EstimatorResult]] = {
    "joint": Estimation.joint,
    "posegraph": Estimation.posegraph,
    "posegraph_isotropic": partial(Estimation.posegraph, isotropic=True),
    "posegraph_paper": partial(
        Estimation.posegraph, isotropic=True, trilateration=trilaterate.intersect
    ),
    "trilateration": lambda one, stage: one._scaled(one.least_squares),
    "three_circles": lambda one, stage: one._scaled(trilaterate.three_circles(one._circled)),
    "eq15": lambda one, stage: trilaterate.require_any(eq15.estimate(one.data)),
    "centroid": lambda one, stage: centroid.estimate(one.data),
    "coactivation": lambda one, stage: layout.estimate(one.data, stage),
}
"""The estimators by name, of an Estimation and the stage whose steps are counted."""


def calibrate(
    recording: Recording,
    belief: Belief,
    method: str = "joint",
    tolerance: float = NEWTON_TOLERANCE,
    iterations: int = MAX_ITERATIONS,
    progress: Progress | None = None,
) -> Calibration:
    """Estimate the pose of every taxel of `belief.taxel_ids` from the readings of `recording`.

    method: "joint", maximum likelihood over all readings (the default); "posegraph", the paper's
    graph of displacements; "posegraph_isotropic", with the paper's isotropic information;
    "posegraph_paper", with displacements from three chosen circles, too;
    "trilateration", least squares over all circles of a taxel; "three_circles", three steep,
    well-separated ones; "eq15", the paper's trilateration as printed: three readings at random,
    taken as those of points; "centroid", the baseline: the mean of its contact points, weighted
    by its readings; "coactivation", the layout by which taxels answer together, for contact points
    that are wrong in themselves: they only place the whole, and the contact model only scales it.
    tolerance: Newton decrement at convergence of the joint estimate; iterations: the most of IPOPT
    in each linearization; other methods and learned responses have neither. progress(stage, done,
    total): called between the steps. Contact points that the robot computed from its own taxels
    give the verdict FAIL, and no estimate. Warns (LeftOutWarning) where taxels are not determined.
    Raises UnknownNameError for another method, ConfigError for tolerance or iterations that are not
    positive or not used, RecordingError for values that are not finite, CalibrationError for a
    scene in place of a belief, a method that needs pressures, no readings, unknown taxels,
    ContactError where the contact model leaves its range.
    """
    check_name("method", method, tuple(METHODS))
    if isinstance(recording, Recording) and recording.points_from_taxels:
        return uncalibrated(recording, belief)
    found = Estimation(recording, belief).calibrate(method, tolerance, iterations, progress)
    warn_left_out("calibrated", found.reasons_left_out, len(found.ids))
    return found
