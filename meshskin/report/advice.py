"""What the data determined, what they did not, and what to do next."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from ..estimation.calibrate import CONSTANT
from ..estimation.uncertainty.metrics import is_ideal, nees_band
from ..exploration.left_out import GIVEN_UP
from .data import ReportData, has_gauge_freedom
from .markup import paragraphs, table
from .theme import significant

FREEDOMS = (
    "position along the skin, taxel x",
    "position along the skin, taxel y",
    "position along the normal",
    "tilt about taxel x",
    "tilt about taxel y",
    "heading: rotation about the normal",
)
FEW_READINGS = 12
"""Fewer readings than this leave a taxel's position weak: its sigma is three times that of a taxel
with 100 readings, a usual number."""
OUTLYING_CHI2 = 3.0
"""A reduced chi-square this many times the median is not noise: with 10 degrees of freedom its
probability is below 1e-3."""
SHOWN_IDS = 20
"""Largest number of ids in a list."""
MODEL_ERROR_RATIO = 1.5
"""A mean error this many times the Cramér-Rao bound is not noise alone: the ratio has a standard
deviation of 6 % with 80 taxels."""


def format_ids(ids: Iterable[object]) -> str:
    """Ids as text, such as "3, 17, 41 and 5 more"."""
    names = [str(k) for k in ids]
    more = f" and {len(names) - SHOWN_IDS} more" if len(names) > SHOWN_IDS else ""
    return ", ".join(names[:SHOWN_IDS]) + more


def _named(ids: np.ndarray) -> str:
    """One taxel or several, by their ids."""
    return f"taxel{'s' * (len(ids) > 1)} {format_ids(ids)}"


def bound_ratio(data: ReportData) -> float | None:
    """Mean error over the Cramér-Rao bound; None if one of them is not known."""
    bound = data.bound_mm
    if data.truth is None or bound is None or not np.isfinite(bound) or bound <= 0:
        return None
    return float(data.main_errors["mean"] / bound)


def observability(data: ReportData) -> list[str]:
    """The degrees of freedom that were determined, factors, anchor, and taxels not located."""
    c = data.calibration
    observed = np.asarray(c.observed, dtype=bool)
    touched, first = int(data.touched.sum()), untested(data)  # listed first on the page
    counts = observed[data.touched].sum(axis=0) if touched else np.zeros(6, dtype=int)
    rows = tuple(
        (name, f"{int(n)} of {touched}", _observability_note(k, int(n), touched))
        for k, (name, n) in enumerate(zip(FREEDOMS, counts, strict=True))
    )
    lines = [
        f"Factors used: {'; '.join(c.factors) or 'none'}.",
        f"Anchor, which fixes the pose of the whole skin: {c.anchor or 'none'}.",
        *(f"Not shown by the log: {words}." for words in c.undetermined if words not in first),
    ]
    if has_gauge_freedom(c) and data.truth is not None:
        lines.append(
            "This method does not determine the pose of the whole skin: errors are given after "
            "the best rigid alignment with the truth."
        )
    lines += missing_taxels(data)
    header = ("degree of freedom", "touched taxels", "")
    return [table(header, rows, numeric=(1,)), paragraphs(*lines)]


def untested(data: ReportData) -> tuple[str, ...]:
    """Errors that the recording cannot show; a simulation has none of them."""
    verdict = data.calibration.verdict
    return () if verdict is None or data.truth is not None else verdict.untested


def missing_taxels(data: ReportData) -> list[str]:
    """Which taxels have no estimate, and the reasons."""
    c = data.calibration
    reason_of = np.where(data.located, "", np.asarray(c.reasons, dtype=str))
    reasons, counts = np.unique(reason_of[~data.located], return_counts=True)
    if not len(reasons):
        return ["Every taxel was touched and located."]
    return [
        f"{count} of {data.count} taxels {'have' if count > 1 else 'has'} "
        f"no estimate ({reason or 'no reason given'}): "
        f"{format_ids(np.asarray(c.ids)[~data.located & (reason_of == reason)])}."
        for reason, count in zip(reasons.tolist(), counts.tolist(), strict=True)
    ]


def _observability_note(freedom: int, count: int, touched: int) -> str:
    if count == touched:
        return "determined"
    if freedom == 5 and count == 0:
        return (
            "not determined: the reading of a round taxel does not depend on its heading; the "
            "heading of its frame is a convention"
        )
    if count == 0:
        return "not determined by these data; no number is given"
    lost = touched - count
    return f"not determined for {lost} taxel{'s' * (lost > 1)}"


def next_steps(data: ReportData) -> Sequence[str]:
    """Advice that follows from the numbers, most urgent first."""
    touches = [f"Touch next: {words}." for words in data.metrics.get("next_touches", ())]
    steps = [*touches, *_contacts(data), *_model_errors(data), *_noise(data)]
    if not data.located.any():  # the verdict says what to record instead
        return tuple(steps)
    if not np.asarray(data.calibration.observed, dtype=bool)[:, 5].any():
        steps.append(
            "If headings are needed, take them from the known layout of the skin's modules: "
            "contacts with round taxels do not determine them."
        )
    if data.truth is None:
        steps.append(
            "To know what error to expect, simulate this body, path and noise, and compare the "
            "errors in that report with the uncertainty stated here."
        )
    return tuple(steps)


def _contacts(data: ReportData) -> list[str]:
    """Where contacts are missing; nothing where none would do (estimation/uncalibrated.py)."""
    c = data.calibration
    if c.method == "none":
        return []
    ids, steps = np.asarray(c.ids), []
    constant = np.asarray(c.reasons) == CONSTANT
    if constant.any():
        steps.append(f"Check the wiring of {_named(ids[constant])}: the same reading all the time.")
    untouched = ~data.touched & ~constant
    weak = data.touched & ~np.asarray(c.observed, dtype=bool)[:, :2].all(axis=1) & ~constant
    reasons = {} if data.recording is None else data.recording.metadata.get("unreachable", {})
    reason_of = np.array([reasons.get(str(k), "") for k in ids.tolist()], dtype=object)
    left_out = (untouched | weak) & (reason_of != "")
    for reason in dict.fromkeys(reason_of[left_out]):
        these = _named(ids[left_out & (reason_of == reason)])
        if reason.startswith(GIVEN_UP):
            steps.append(f"The run lost the contacts of {these}: {reason.removeprefix(GIVEN_UP)}.")
            continue
        steps.append(
            f"The plan does not reach {these} ({reason}): "
            "try a smaller indenter, less force or another mount, or leave them out."
        )
    untouched, weak = untouched & ~left_out, weak & ~left_out
    if untouched.any():
        steps.append(
            f"Extend the contact path to {_named(ids[untouched])}, or mark what is defective."
        )
    if weak.any():
        steps.append(
            f"Pass {_named(ids[weak])} on both sides: the contacts do not determine the "
            "position along the skin."
        )
    few = data.touched & ~weak & ~left_out & (np.asarray(c.readings) < FEW_READINGS)
    if few.any():
        steps.append(
            f"Press these taxels more often (fewer than {FEW_READINGS} readings each): "
            f"{format_ids(ids[few])}."
        )
    return steps


def _model_errors(data: ReportData) -> list[str]:
    """What to do where the readings do not agree with the model."""
    steps = []
    bad = outlying_taxels(data)
    if bad.any():
        steps.append(
            f"Check {_named(np.asarray(data.calibration.ids)[bad])}: their residuals "
            "are far above those of the other taxels (a wrong gain, swapped wiring, or an "
            "estimate in a local minimum)."
        )
    ratio = bound_ratio(data)
    if ratio is not None and ratio > MODEL_ERROR_RATIO:
        steps.append(
            f"The error is {significant(ratio)} times the Cramér-Rao bound: look for what the "
            "model leaves out (contact model, indenter offset, gains) before recording more."
        )
    return steps


def _noise(data: ReportData) -> list[str]:
    """What to do about the stated uncertainty."""
    s = data.finite_sigma_mm
    if not len(s):
        return []
    if is_ideal(data.calibration):
        return [
            "These data contain almost no noise: simulate with the noise of the sensor to know "
            "what error to expect."
        ]
    return [
        *_consistency(data),
        f"To halve the uncertainty of {significant(float(np.median(s)))} mm, record four times as "
        "many readings, or halve the sensor noise.",
    ]


def _consistency(data: ReportData) -> list[str]:
    """What to do where the errors do not agree with the stated uncertainty."""
    given = data.metrics.get("nees")
    mean = given.get("mean") if isinstance(given, Mapping) else given
    count = int(data.located.sum())
    if data.truth is None or mean is None or not count:
        return []
    low, high = nees_band(count)
    if not np.isfinite(mean) or low <= mean <= high:
        return []
    side = "too small" if mean > high else "too large"
    return [
        f"The stated uncertainty is {side}: the NEES of {significant(float(mean))} is outside its "
        f"95 % band, {significant(low)} to {significant(high)} (by chance in 1 run of 20). Check "
        "the noise given to the calibration, and what its model leaves out."
    ]


def outlying_taxels(data: ReportData) -> np.ndarray:
    """Which taxels (n,) have a chi-square far above those of the others."""
    chi2 = np.asarray(data.calibration.chi2, dtype=float)
    good = np.isfinite(chi2) & data.touched
    if not good.any():
        return np.zeros(data.count, dtype=bool)
    typical = max(float(np.median(chi2[good])), 1.0)
    return np.asarray(good & (np.where(good, chi2, 0.0) > OUTLYING_CHI2 * typical))
