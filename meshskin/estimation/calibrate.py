"""From a recording and a belief to a calibration, by any of the estimators."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypedDict

import numpy as np

from ..core.arguments import check_type
from ..core.errors import CalibrationError, UnknownNameError
from ..core.provenance import digest, provenance
from ..core.se3 import Array
from ..recording.recording import Recording
from . import chart
from .calibration import Calibration
from .data.measurements import Measurements, gather
from .data.resolve_belief import resolve_belief
from .joint import maximum_likelihood
from .joint.newton import NEWTON_TOLERANCE
from .trilateration import displacements, trilaterate
from .uncertainty import gauge, observability
from .uncertainty.goodness_of_fit import GoodnessOfFit

if TYPE_CHECKING:
    from ..scene.belief import Belief

UNTOUCHED = "never touched"
ALONE = "shares too few contacts with other taxels"
WEAK = "too weakly determined"
SURFACE = "body surface: position along the normal and tilt"
MODULES = "rigid modules: the known places of their taxels"
MODULE_SURFACE = "body surface: modules lie on it to 0.1 mm a taxel"
CONTACTS = "contact points in the body frame"
DRAWN = 240
"""Taxels, at least, whose errors are drawn to see what displacements share."""


class Told(TypedDict, total=False):
    """What some methods tell beside the poses: fields of a Calibration."""

    modulus: float | None
    modulus_sigma: float | None
    unknowns: Mapping[str, tuple[float, float]]
    undetermined: tuple[str, ...]
    taxel_unknowns: Mapping[str, Array]
    faults: np.ndarray
    fit: GoodnessOfFit
    iterates: Array


@dataclass(frozen=True)
class Answer:
    """What a method says of n taxels."""

    points: Array
    """Positions (n, 3), body frame, m; NaN where there is none."""
    rotations: Array
    """(n, 3, 3), taxel frame to body frame."""
    reasons: np.ndarray
    """Why a taxel has no position (n,) str; "" where it has."""
    chi2: Array
    """(n,), as in a Calibration."""
    anchor: str
    factors: tuple[str, ...]
    covariances: Array | None = None
    """(n, 6, 6) of the poses, as in a Calibration; None: they follow from `tangential`."""
    tangential: Array | None = None
    """(n, 2, 2) in the tangent plane, m^2, of taxels that lie on the body's surface."""
    told: Told = field(default_factory=Told)
    seconds: Mapping[str, float] = field(default_factory=dict)


def calibrate(
    recording: Recording, belief: Belief, method: str = "joint", tolerance: float = NEWTON_TOLERANCE
) -> Calibration:
    """Where every taxel of `belief.taxel_ids` is, by the readings of `recording`.

    method: "joint", maximum likelihood over all readings (the default); "posegraph", the paper's
    graph of displacements; "posegraph_isotropic", with the paper's isotropic information;
    "posegraph_paper", with displacements from three circles, too, as in the paper;
    "trilateration", least squares on all circles of a taxel; "three_circles", the paper's.
    tolerance: the Newton decrement at which the joint estimate rests (a move of sqrt(2 tolerance)
    standard deviations); the other methods have no use for it.
    Raises UnknownNameError for another method, RecordingError for values that are not finite,
    CalibrationError for a scene in place of a belief, no readings, unknown taxels or nothing
    determined, ContactError where the believed contact model leaves its range.
    """
    if method not in METHODS:
        raise UnknownNameError("method", method, METHODS)
    check_type(Recording, recording, "what is calibrated")
    if not hasattr(belief, "taxel_ids"):
        raise CalibrationError(
            "no belief",
            value=type(belief).__name__,
            remedy="give what the robot's owner knows: scene.belief()",
        )
    begin = time.perf_counter()
    data = gather(recording, belief)
    belief = resolve_belief(belief, recording)
    gathered = time.perf_counter()
    options = {"tolerance": tolerance} if method == "joint" else {}
    answer = METHODS[method](data, belief, **options)
    seconds = {"gather": gathered - begin, **answer.seconds}
    return _assemble(
        data,
        belief,
        method,
        answer,
        seconds | {"total": time.perf_counter() - begin},
        provenance(
            method=method,
            recording=digest(recording.points, recording.force, recording.pressure),
            source=recording.metadata.get("provenance", {}),
        ),
    )


def _assemble(
    data: Measurements,
    belief: Belief,
    method: str,
    answer: Answer,
    seconds: dict[str, float],
    source: dict[str, Any],
) -> Calibration:
    """Fill in what all methods share, and take back what is too weak to be an estimate."""
    points, rotations, covariance = answer.points, answer.rotations, answer.covariances
    if covariance is None:
        assert answer.tangential is not None
        shape = observability.shape_operators(belief.body, points, rotations)
        covariance = observability.pose_covariance(answer.tangential, shape)
    observed = observability.degrees_of_freedom(covariance, float(np.median(data.radii)))
    why = np.array(answer.reasons, dtype=object)
    why[(data.counts == 0) & (why != "")] = UNTOUCHED
    lost = np.asarray(~observed.any(axis=1))
    why[lost & (why == "")] = WEAK
    covariance = np.where(lost[:, None, None], np.diag([np.inf] * 6), covariance)
    return Calibration(
        ids=data.ids,
        poses=chart.poses(np.where(lost[:, None], np.nan, points), rotations),
        covariances=covariance,
        observed=observed,
        touched=data.counts > 0,
        readings=data.counts,
        method=method,
        anchor=answer.anchor,
        factors=answer.factors,
        chi2=answer.chi2,
        reasons=why,
        seconds=seconds,
        provenance=source,
        contact_centroids=trilaterate.centroids(data, belief.body),
        belief=belief,
        **answer.told,
    )


def _joint(data: Measurements, belief: Belief, tolerance: float = NEWTON_TOLERANCE) -> Answer:
    found = maximum_likelihood.estimate(data, belief.body, tolerance=tolerance)
    silent: tuple[str, ...] = ()
    if data.noise:
        silent = ("silent readings, censored at the threshold",)
    surface: tuple[str, ...] = (SURFACE,)
    if data.left_out:
        silent += (f"without {data.left_out} contacts in which the contact model does not hold",)
    if found.covariances is not None:
        surface = (MODULES, MODULE_SURFACE)
    shared = found.data.shared
    if shared.local_names != data.shared.local_names:
        surface += ("gain and offset of each taxel, undeclared: without them taxels misfit",)
    return Answer(
        points=found.points,
        rotations=found.rotations,
        covariances=found.covariances,
        tangential=found.covariance,
        reasons=found.reasons,
        chi2=found.chi2,
        anchor=CONTACTS,
        factors=("pressure of each reading", *silent, *surface, *shared.prior_words()),
        seconds=found.seconds,
        told={
            "faults": found.faults,
            "modulus": found.modulus,
            "modulus_sigma": found.modulus_sigma,
            "unknowns": found.unknowns,
            "undetermined": found.undetermined,
            "taxel_unknowns": {
                name: np.stack([found.extras[:, k], found.extras_sigma[:, k]], axis=1)
                for k, name in enumerate(shared.local_names)
            },
            "fit": found.fit,
            "iterates": np.stack(found.iterates),
        },
    )


def _trilateration(estimator: Callable[..., trilaterate.Fit]) -> Callable[..., Answer]:
    def run(data: Measurements, belief: Belief) -> Answer:
        fit = estimator(data, belief.body)
        _require(fit)
        scale = 1.0 if data.noise else float(np.nanmedian(fit.chi2))
        return Answer(
            points=fit.points,
            rotations=fit.rotations,
            tangential=fit.covariance * (scale if np.isfinite(scale) else 1.0),
            reasons=fit.reasons,
            chi2=fit.chi2,
            anchor=CONTACTS,
            factors=("distance of each reading, at the nominal E*", SURFACE),
        )

    return run


def _require(fit: trilaterate.Fit) -> None:
    if not fit.found.any():
        raise CalibrationError(
            "no taxel is determined by the recording",
            value=", ".join(sorted(set(map(str, fit.reasons)))),
            remedy="touch every taxel from at least three contacts that are not on a line",
        )


def _posegraph(
    isotropic: bool, trilateration: displacements.Trilateration = trilaterate.solve
) -> Callable[..., Answer]:
    def run(data: Measurements, belief: Belief) -> Answer:
        begin = time.perf_counter()
        fit = trilaterate.least_squares(data, belief.body)
        _require(fit)
        draws = -(-DRAWN // max(int(fit.found.sum()), 1))
        graph, errors = displacements.displacements_with_errors(
            data, belief.body, fit, isotropic, trilateration, draws
        )
        solution = graph.solve(keep_iterates=True)
        placed, linked = gauge.aligned(graph, solution.poses)
        row = np.flatnonzero(fit.found)
        poses = np.full((len(fit.reasons), 4, 4), np.nan)
        poses[row[linked]] = placed[linked]
        why = fit.reasons.copy()
        why[row[~linked]] = ALONE
        covariances = np.tile(np.diag([np.inf] * 6), (len(why), 1, 1))
        covariances[row[linked]] = gauge.covariances(graph, placed, errors)[linked]
        covariances[:, observability.SPIN, :] = covariances[:, :, observability.SPIN] = 0.0
        covariances[:, observability.SPIN, observability.SPIN] = np.inf
        steps = solution.iterates if solution.iterates is not None else poses[None]
        iterates = np.full((len(steps), len(why), 3), np.nan)
        for k, step in enumerate(steps):
            iterates[k, row[linked]] = gauge.aligned(graph, step)[0][linked, :3, 3]
        return Answer(
            points=poses[:, :3, 3],
            rotations=poses[:, :3, :3],
            covariances=covariances,
            reasons=why,
            chi2=np.full(len(why), np.nan),
            told={"iterates": iterates},
            seconds={
                "graph": time.perf_counter() - begin,
                "build": solution.build_time,
                "solve": solution.solve_time,
            },
            anchor="rigid alignment of each connected part with the trilaterated positions",
            factors=(
                f"{len(graph.edges)} displacements of taxels active together, "
                f"{'isotropic' if isotropic else 'full'} information, taken as independent; "
                "the covariance is scaled by what readings that they share do",
                "spin of each frame: a convention",
            ),
        )

    return run


METHODS: dict[str, Callable[..., Answer]] = {
    "joint": _joint,
    "posegraph": _posegraph(isotropic=False),
    "posegraph_isotropic": _posegraph(isotropic=True),
    "posegraph_paper": _posegraph(isotropic=True, trilateration=trilaterate.intersect),
    "trilateration": _trilateration(trilaterate.least_squares),
    "three_circles": _trilateration(trilaterate.three_circles),
}
"""The estimators by name."""
