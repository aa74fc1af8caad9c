"""The verdict on a calibration: whether its positions and standard deviations can be relied on.

Each check compares something the estimate did not use, or used as a prior, with the data: the test
of fit, E* against the nominal material, the positions against the pressure-weighted means of the
contact points, the contact points against the believed surface, and the columns of the log.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from ...core.arrays import Array
from ...recording.recording import Recording
from ..calibration import Calibration
from ..data import delay
from ..data.global_parameters import ELECTRONICS, LEARNED, PRIOR_SIGMAS, SIZES, declared_parameters
from ..data.measurements import Measurements
from ..data.patch_shape import MAX_EDGES
from ..joint.departures import MIN_SCORE
from ..joint.jump import JUMP, MIN_JUMP
from ..learned.contact_correlations import MAX_CORRELATION
from . import frame_errors, verdict, weighted_means
from .contact_errors import SURFACE_DEPTHS, displacement, nearer_points, on_surface
from .goodness_of_fit import STRONG, undeclared
from .unseen_motions import unseen_motions
from .verdict import DOUBT, FAIL, LEVELS, PASS, Finding, Verdict, level_of

MAX_MISFIT = 0.05
"""Residuals beyond the noise, relative to the strong readings, from which a model that does not fit
is a failure: a contact's position by readings that are 5 % wrong is 0.2 mm off in 4 mm."""
MAX_OVERSTATED = 3.0
"""Largest ratio of a stated noise to the residuals, before it is a doubt."""
MAX_NOISE = 0.15
"""Estimated noise, relative to the median taxel's largest reading, that is too large for a sensor:
noise of 10 % of the peak pressure is below it."""
MODULUS_FACTORS = 3.0, 10.0
"""Factors between the estimated and the nominal E*: a doubt, a failure. Nominal values of
elastomers by Shore hardness are within a factor of 2; pressures 2 and 4 times wrong change E* by
factors of 2.7 and 17, since the patch must fit, too."""
MAX_FAULTY = 0.2
"""Fraction of faulty taxels from which the log is in doubt, not the taxels."""
MIN_AHEAD = 3.0
"""Standard deviations from which patches count as ahead of the contacts; friction puts them behind.
"""
NAMED = 4
"""Number of departures that a reason names; a strong one raises the scores of similar ones."""
MIN_DISPLACEMENT = 0.02
"""Scatter of the contact points, in contact radii, from which their correlation is judged."""


def judge(
    recording: Recording,
    data: Measurements,
    calibration: Calibration,
    departures: Mapping[str, float],
    places: list[Finding],
) -> Verdict:
    """The verdict on the calibration of `data`, which were gathered from `recording`; departures:
    as `EstimatorResult.departures`; places: `SecondPlaces.findings`."""
    found: list[Finding] = [
        *_fit(data, calibration),
        *_departures(data, calibration, departures),
        *_late(data),
        *_ahead(data, calibration),
        *_noise(data, calibration),
        *_modulus(data, calibration),
        *verdict.scale(data, calibration),
        *_priors(data, calibration),
        *_of_log(recording, data, calibration.unknowns),
        *_edges(data),
        *weighted_means.findings(data, calibration),
        *places,
        *verdict.forces(recording, calibration),
        *verdict.force_offset(data, calibration),
        *verdict.alike(calibration),
        *verdict.few_readings(calibration),
        *verdict.profile(data, calibration),
        *verdict.joint_angles(recording, data),
        *verdict.times(recording),
        *verdict.clocks(recording, data, calibration),
        *_faults(calibration),
        *_contacts(data, calibration),
    ]
    found.sort(key=lambda finding: -LEVELS.index(finding[0]))
    level, reasons = found[0][0] if found else PASS, tuple(words for _, words in found)
    return Verdict(level, reasons, unseen_motions(data))


def fails_by_itself(recording: Recording, data: Measurements) -> bool:
    """Whether the log is a failure by its own columns, whatever is estimated from it."""
    names = data.parameters.names
    if data.parameters.move_contacts or "indenter_offset" in names or "body_offset" in names:
        return False
    return any(level == FAIL for level, _ in _of_log(recording, data, {}))


def _of_log(
    recording: Recording, data: Measurements, unknowns: Mapping[str, tuple[float, float]]
) -> Iterator[Finding]:
    """Findings on the columns of the log that use no estimate but the offsets among `unknowns`."""
    points = nearer_points(data, unknowns)
    yield from _surface(data, points)
    yield from frame_errors.findings(recording, data, points)
    yield from verdict.pressures(recording, data)


def _fit(data: Measurements, calibration: Calibration) -> Iterator[Finding]:
    """The test of fit."""
    fit = calibration.fit
    if fit is None:
        yield verdict.doubt(
            f"the method {calibration.method} has no test of fit: compare with the verdict of "
            'method="joint"'
        )
        return
    if fit.good and data.noise is not None and fit.reduced < MAX_OVERSTATED**-2:
        yield verdict.doubt(
            f"residuals are {fit.reduced**0.5:.2g} times the stated noise, {fit.noise:.3g} Pa "
            f"(limit {1 / MAX_OVERSTATED:.2g}): the pressures are too small, or it is overstated; "
            "check the scale of pressures, or leave noise_sigma out of the belief"
        )
        return
    if fit.good is not False:
        return
    beyond = fit.noise * max(fit.reduced - 1.0, 0.0) ** 0.5
    severe = beyond > MAX_MISFIT * float(np.quantile(data.pressure, STRONG))
    yield FAIL if severe else DOUBT, fit.words


def _departures(
    data: Measurements, calibration: Calibration, departures: Mapping[str, float]
) -> Iterator[Finding]:
    """Departures from the model that the readings show and the estimate does not include."""
    if calibration.fit is not None and calibration.fit.of_computing(data.pressure):
        return
    shown = sorted(
        (-score, name)
        for name, score in departures.items()
        if score > (MIN_JUMP if name.startswith(JUMP) else MIN_SCORE)
    )
    if not shown:
        return
    named = [f"{name} (score {-score:.3g})" for score, name in shown[:NAMED]]
    if len(shown) > NAMED:
        named.append(f"{len(shown) - NAMED} weaker ones")
    words = (
        f"the readings show {', '.join(named)} beyond what the estimate models (scores in "
        f"standard deviations, limit {MIN_SCORE:g}, of a jump {MIN_JUMP:g})"
    )
    if calibration.fit is not None and calibration.fit.good is not False:
        words += ": its standard deviations can be too small"
    if calibration.response is None and data.belief.module_slots is None:
        words += '; let it learn the response: contact="learned"'
    yield DOUBT, words


def _noise(data: Measurements, calibration: Calibration) -> Iterator[Finding]:
    """The estimated noise: more than that of any sensor is an error of the log."""
    fit, largest = calibration.fit, np.zeros(len(data.ids))
    np.maximum.at(largest, data.taxel, data.pressure)
    strong = float(np.median(largest[data.counts > 0]))  # most readings may be noise
    if data.noise is not None or fit is None or not fit.noise > MAX_NOISE * strong:
        return
    yield verdict.doubt(
        f"the noise, estimated from neighbouring contacts, is {fit.noise / strong:.0%} of the "
        f"taxels' largest readings (limit {MAX_NOISE:.0%}): check the times of the readings and "
        "the contact points, or state the sensor's noise"
    )


def _late(data: Measurements) -> Iterator[Finding]:
    """Readings that fit the contacts some frames earlier or later better."""
    if data.delays:
        parts = (f"from {part:.0%} of the recording on {_frames(k)}" for part, k in data.delays[1:])
        yield verdict.doubt(
            f"the readings are {_frames(data.delay)}, {', '.join(parts)}: without these delays the "
            "contacts that each taxel responds to lie closer together, and they were removed; look "
            "for frames that were lost or doubled there, and for clocks that run at different "
            "rates, and correct the times of the readings"
        )
        return
    if not data.delay:
        return
    moved, _ = delay.displacements(data, data.delay)
    path = float(np.median(np.linalg.norm(moved, axis=1)))
    yield verdict.doubt(
        f"the readings are {_frames(data.delay)}, in which the "
        f"contact moves {1e3 * path:.2g} mm: without this delay the contacts that each taxel "
        "responds to lie closer together, and it was removed; the standard deviations include a "
        "delay of a part of a frame; correct the times of the readings, unless the skin is dragged "
        "along, which has the same effect"
    )


def _frames(late: int) -> str:
    if not late:
        return "in time"
    count = "1 frame" if abs(late) == 1 else f"{abs(late)} frames"
    return f"{count} too {'late' if late > 0 else 'early'}"


def _ahead(data: Measurements, calibration: Calibration) -> Iterator[Finding]:
    """Patches ahead of the contacts: readings are taken a part of a frame after the contacts'
    times."""
    drag, sigma = calibration.unknowns.get("drag", (0.0, np.inf))
    if not drag < -MIN_AHEAD * sigma:  # nor where a sigma is unknown
        return
    step = float(np.median(np.linalg.norm(np.diff(data.points, axis=0), axis=1)))
    yield verdict.doubt(
        f"the patches are {-1e3 * drag:.2g} mm ahead of the contacts ({-drag / sigma:.2g} standard "
        f"deviations, limit {MIN_AHEAD:g}): readings are taken {-drag / step:.2g} frames after the "
        "times of their contacts; taxels that are crossed in one direction do not show whether "
        "that holds for all: correct the times of the readings, or cross each taxel in several "
        "directions"
    )


def _modulus(data: Measurements, calibration: Calibration) -> Iterator[Finding]:
    if calibration.modulus is None or calibration.modulus_sigma is None:
        return
    ratio = calibration.modulus / data.modulus
    level = level_of(max(ratio, 1 / ratio), MODULUS_FACTORS)
    if level == PASS:
        return
    words = (
        f"E* is {calibration.modulus / 1e3:.3g} kPa, {ratio:.3g} times the nominal "
        f"{data.modulus / 1e3:.3g} kPa (limit: a factor of {MODULUS_FACTORS[0]:g}): check the "
        "scale of pressures and forces, the indenter's radius and the nominal Young's modulus"
    )
    yield level, words


def _priors(data: Measurements, calibration: Calibration) -> Iterator[Finding]:
    """Global parameters, other than those of a learned response, against their priors."""
    learned = {*LEARNED, *ELECTRONICS}  # free by design; errors of the forces bend the exponents
    names = tuple({label.split()[0] for label in calibration.unknowns} & (set(SIZES) - learned))
    force, peak = data.belief.force_reference or 1.0, data.nominal_peak
    declared = declared_parameters(names, data.belief.priors, force, peak)
    for label, sigma in zip(declared.labels, declared.sigma, strict=True):
        value, apart = calibration.unknowns[label][0], abs(calibration.unknowns[label][0]) / sigma
        if apart > PRIOR_SIGMAS:
            yield verdict.doubt(
                f"{label} is {value:.3g}, {apart:.3g} standard deviations of its prior, "
                f"{sigma:.3g}, from zero (limit {PRIOR_SIGMAS:g}): another error of the log may "
                "be the cause; check poses and times, or widen the prior (belief.priors)"
            )


def _surface(data: Measurements, points: Array) -> Iterator[Finding]:
    """Distances of contact points (m, 3), m, from the believed surface."""
    hit, best = on_surface(data, points)
    distance, median = hit.distance, float(np.median(hit.distance))
    typical, move = float(np.median(np.abs(distance))), displacement(distance, hit.normal)
    depth = data.indentation
    moved = float(np.sqrt(np.mean(np.trace(best.squares(data.points), axis1=1, axis2=2))))
    size = max(typical, float(np.linalg.norm(move)), moved)
    level = level_of(size / depth, SURFACE_DEPTHS)
    if level == PASS:
        return
    side, extra = "above" if median > 0 else "below", ""
    where = f"{side} the believed surface" if abs(median) > 0.5 * typical else "off the surface"
    if best.turn.any() or best.stretch:
        move, turn = best.shift, ", ".join(f"{-x:.2g}" for x in np.degrees(best.turn))
        extra = f", turned about the body's middle by ({turn}) degrees"
        extra += f" and scaled by {1 - best.stretch:.4g}" if best.stretch else ""
    words = (
        f"contact points lie {1e3 * typical:.3g} mm {where} in the median, and nearest to it if "
        f"moved by ({', '.join(f'{-1e3 * x:.2g}' for x in move)}) mm{extra} (limit "
        f"{1e3 * SURFACE_DEPTHS[0] * depth:.2g} mm, a tenth of the indentation): check the body's "
        "scale and frame, the indenter's position and its radius"
    )
    if declare := undeclared(data.belief):
        words += f", or {declare}"
    yield level, words


def _edges(data: Measurements) -> Iterator[Finding]:
    """Contacts over edges of the body, where no contact model describes the patch."""
    count, all_contacts = data.edges, len(data.points)
    if count <= MAX_EDGES * all_contacts:
        return
    yield verdict.doubt(
        f"{count} of {all_contacts} contacts are over edges of the body (limit {MAX_EDGES:.0%}), "
        "where the contact model does not hold: whether it holds elsewhere is not tested; let it "
        'learn the response: contact="learned"; or believe a smoother body'
    )


def _faults(calibration: Calibration) -> Iterator[Finding]:
    if not np.isfinite(calibration.positions).all(axis=1).any():
        undetermined = "; ".join(calibration.undetermined) or "see the reasons of the taxels"
        yield FAIL, f"no taxel is determined: {undetermined}"
        return
    if calibration.faults is None:
        return
    touched = np.asarray(calibration.touched, dtype=bool)
    faulty, limit = np.array([bool(words) for words in calibration.faults]) & touched, MAX_FAULTY
    rivals = np.zeros(len(touched), dtype=bool)
    if calibration.rivals is not None:
        rivals = np.isfinite(calibration.rivals[:, 0])
    if rivals.sum() > limit * touched.sum():
        yield verdict.doubt(
            f"two positions fit the readings of {rivals.sum()} of {touched.sum()} taxels (limit "
            f"{limit:.0%}): touch these taxels from more sides"
        )
    if (faulty & ~rivals).sum() > limit * touched.sum():
        yield verdict.doubt(
            f"{(faulty & ~rivals).sum()} of {touched.sum()} taxels have faults (limit "
            f"{limit:.0%}): so many point to the log or the contact model; see the faults of the "
            "taxels"
        )


def _contacts(data: Measurements, calibration: Calibration) -> Iterator[Finding]:
    """Displacements of the contacts that a learned response found: errors of a kinematic model or
    of the clocks are alike in neighbouring contacts, scatter is not."""
    response = calibration.response
    if response is None or response.contact_correlation < MAX_CORRELATION:
        return
    if response.contact_scatter < MIN_DISPLACEMENT * float(np.median(data.radii)):
        return
    declare = undeclared(data.belief)
    yield verdict.doubt(
        f"contact points are {1e3 * response.contact_scatter:.2g} mm off, and neighbouring ones "
        f"alike (correlation {response.contact_correlation:.2f}, limit {MAX_CORRELATION:g}): this "
        "is not scatter, but an error of the kinematic model or of the clocks; "
        f"{declare + ', or ' * bool(declare)}correct the times; the standard deviations are "
        "widened for this correlation"
    )
