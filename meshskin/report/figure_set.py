"""The figures of a report, with their captions."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..core.beside import Beside
from ..core.errors import OutOfTime
from ..core.progress import Progress, Stage
from ..simulation.response import CONTROLLED_PHASES, controlled_force, force_response
from . import curves, learned_response, maps, precision, theme
from .data import ReportData
from .markup import SavedFigure
from .plane import MM, finite_rows

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ..recording.recording import Recording


Drawn = dict[str, SavedFigure | None]
"""Figures by name; None for those that the data do not allow."""
ACCURACY_TIME, RESIDUALS = "accuracy_time", "residuals"
"""Names of the figures that have sections of their own."""


def draw_figures(
    folder: Path,
    data: ReportData,
    progress: Progress | None,
    early: Drawn | None = None,
    beside: bool = False,
) -> tuple[list[SavedFigure], list[str]]:
    """Draw and save every figure that the data allow, but those drawn `early`; in the order of the
    page.

    beside: draw some figures beside the others. Otherwise `progress` may raise OutOfTime: those not
    drawn by then are the last ones; their names come second.
    """
    drawn = dict(early or {})
    names = [name for name in _names(data) if name not in drawn]
    later = [name for name in names if beside and name in BESIDE]
    if later:
        import matplotlib.figure  # noqa: F401  once, not in both processes
    with Beside(lambda: draw_named(folder, data, later), bool(later)) as other, suppress(OutOfTime):
        stage = Stage(progress, "report", len(names))
        for name in names:
            if name not in later:
                drawn |= draw_named(folder, data, [name])
                stage.step()
        drawn |= other.result()
        stage.at(len(names))
    pictures = [drawn[name] for name in _names(data) if name in drawn]
    left_out = [name.replace("_", " ") for name in names if name not in drawn]
    return [picture for picture in pictures if picture is not None], left_out


def draw_named(folder: Path, data: ReportData, names: Sequence[str]) -> Drawn:
    """Draw and save figures by their names."""
    return {draw.__name__: draw(folder, data) for draw in DRAWN if draw.__name__ in names}


def _names(data: ReportData) -> list[str]:
    """The figures, in the order of the page."""
    return [draw.__name__ for draw in DRAWN if data.truth is None or draw is not residuals]


def _save(
    folder: Path, name: str, figure: Figure, title: str, caption: str, alt: str
) -> SavedFigure:
    return SavedFigure(*theme.save(figure, folder, name), title, caption, alt)


def _projection_note(data: ReportData) -> str:
    """A note for the caption where the skin is not nearly parallel to the plane of the map."""
    normals = finite_rows(data.shown_poses[:, :3, 2])
    outward = np.cross(*data.plane.axes)
    least = float(np.min(normals @ outward, initial=1.0))
    if least < 0:
        return " The skin extends around the body: its far side is drawn over the near side."
    if least < 0.5:
        return " The skin is inclined by more than 60 degrees at the rim, which appears shortened."
    return ""


def force(folder: Path, data: ReportData) -> SavedFigure | None:
    """Fig. 4: contact force and its reference; of a log, its contact force."""
    recording = data.recording
    if recording is None or not len(recording.time):
        return None
    if recording.motion is None or not recording.motion.num_rows:
        return _recorded_force(folder, recording, data) if recording.force_measured else None
    time, values, goal, phase = controlled_force(recording.motion)
    settling = force_response(time, values, goal, phase).settling
    values = np.where(np.isin(phase, CONTROLLED_PHASES), values, np.nan)
    sliding = phase == "slide"
    steady = sliding if sliding.any() else None
    return _save(
        folder,
        "fig4_force",
        curves.force(time, values, goal, settling, steady),
        "Contact force and its reference over time (the paper's fig. 4)",
        "Left: the whole run; the line is interrupted where the force is not controlled. Middle: "
        "first touch and settling. Right: the force while the contact slides, enlarged, without "
        "contacts of other references. Good: the "
        "force settles in less than 0.1 s, does not overshoot the band, and never falls to zero "
        "while the contact slides.",
        "Contact force and its reference over time",
    )


def _recorded_force(folder: Path, recording: Recording, data: ReportData) -> SavedFigure:
    """The contact force of contacts without the motion between them."""
    reference = data.metrics.get("force", {}).get("reference_n")
    reference = recording.metadata.get("force_reference_n", reference)
    references = recording.metadata.get("forces_n", [] if reference is None else [reference])
    time = recording.time - recording.time[0]
    return _save(
        folder,
        "fig4_force",
        curves.recorded_force(time, recording.force, references),
        "Contact force over time",
        "The line is interrupted where the log has no contact. Good: forces of one size, or, for a "
        "learned response, of several.",
        "Contact force over time",
    )


def response(folder: Path, data: ReportData) -> SavedFigure | None:
    """The learned response, where it was learned."""
    learned = data.calibration.response
    if learned is None:
        return None
    return _save(
        folder,
        learned_response.NAME,
        learned_response.figure(learned),
        learned_response.TITLE,
        learned_response.CAPTION,
        "Learned profile beside the contact model's, and readings over levels",
    )


def estimates(folder: Path, data: ReportData) -> SavedFigure | None:
    """Fig. 5: estimates and true positions."""
    if data.truth is None:
        return None
    return _save(
        folder,
        "fig5_estimates",
        maps.estimates(data),
        "Estimated and true positions (the paper's fig. 5)",
        "True discs in their size and estimated centres, on the tangent plane at the skin's centre "
        "seen from outside; errors are enlarged by the factor in the legend. Good: short error "
        "lines in random directions; lines in one direction mean a shift of the whole skin."
        + _projection_note(data),
        "Map of true discs with estimated centres and enlarged errors",
    )


def errors(folder: Path, data: ReportData) -> SavedFigure | None:
    """Histograms of the position errors."""
    if not data.errors:
        return None
    bound = data.bound_mm
    bound = None if bound is None or not np.isfinite(bound) or bound <= 0 else bound / MM
    return _save(
        folder,
        "errors",
        curves.errors(data.errors, bound),
        "Position errors of every method",
        "Number of taxels over their error, on a logarithmic axis. Good: the errors of the joint "
        "estimate are near the Cramér-Rao bound (dashed), the lowest mean error of an unbiased "
        "estimate."
        if bound is not None
        else "Number of taxels over their error, on a logarithmic axis. Further left is better.",
        "Histograms of position errors by method",
    )


def uncertainty(folder: Path, data: ReportData) -> SavedFigure | None:
    """Map of the stated uncertainty."""
    if not np.isfinite(data.sigma).any():
        return None
    return _save(
        folder,
        "uncertainty",
        maps.uncertainty(data),
        "Stated uncertainty of every taxel",
        "1-sigma ellipses of the estimated positions, enlarged by the factor in the legend. Good: "
        "small, round ellipses of equal size; long ones at the rim point in the direction in which "
        "contacts are missing." + _projection_note(data),
        "Map of 1-sigma ellipses of the taxels",
    )


def coverage(folder: Path, data: ReportData) -> SavedFigure | None:
    """Map of the number of readings."""
    if not np.isfinite(data.display_positions).any():
        return None
    missing = int((~data.touched).sum())
    lost = f" {missing} untouched taxels are not drawn, because their position is unknown."
    return _save(
        folder,
        "coverage",
        maps.coverage(data),
        "Coverage of the exploration",
        "Number of readings of each taxel (colours on a logarithmic scale)"
        + ("" if data.recording is None else ", and the path of the contact over the skin")
        + ". Good: no crosses, passes on both sides of every taxel, and no taxel much darker than "
        "its neighbours."
        + (lost if missing and data.truth is None else "")
        + _projection_note(data),
        "Map of readings per taxel with the contact path",
    )


def accuracy_time(folder: Path, data: ReportData) -> SavedFigure | None:
    """Errors and seconds of the estimators, and seconds of the stages."""
    points = {
        name: (seconds, float(np.nanmean(data.errors[name])) * MM)
        for name, seconds in data.method_seconds.items()
        if name in data.errors and np.isfinite(data.errors[name]).any()
    }
    if not points or not data.seconds:
        return None
    return _save(
        folder,
        ACCURACY_TIME,
        precision.accuracy_time(points, data.seconds, data.bound_mm or None),
        "Accuracy and time of this run",
        "Left: mean error and time of each estimator on the same recording; further left and lower "
        "is better, and the dashed line is the Cramér-Rao bound. Right: time of each stage until "
        "the figures were drawn.",
        "Mean error over seconds of each estimator, and seconds of each stage",
    )


def iterations(folder: Path, data: ReportData) -> SavedFigure | None:
    """Fig. 6-8: one figure of three panels for the page, and each panel as a file."""
    run = data.iterations
    if run is None:
        return None
    goal = "truth" if run.has_truth else "last iterate"
    start = "Displacements are the true ones with noise; all taxels start at one point. "
    figure = maps.iterations(run, data.plane)
    picture = _save(
        folder,
        "fig6-8_iterations",
        figure,
        "Pose-graph estimates along the iterations (the paper's fig. 6 to 8)",
        (start if run.is_demonstration else "")
        + f"The first, the last and the iterate nearest to half way, of {len(run.positions)} "
        f"iterates. Means are distances in space from the {goal}; the maps show the part along the "
        "skin. Good: in the last panel every estimate is inside its ring or next to it.",
        "Maps of the estimates at the first, middle and last iteration",
    )
    panels = [f"fig{6 + k}_iteration" for k in range(3)]
    return replace(picture, also=theme.save_panels(figure, folder, panels))


def residuals(folder: Path, data: ReportData) -> SavedFigure | None:
    """Map of the residuals, of calibrations without a truth."""
    if not np.isfinite(data.residuals).any():
        return None
    words = (
        "Root mean square residual of the readings of each taxel, relative to that of the median "
        "taxel; taxels with a fault are ringed. Good: all near 1, without order. A region of large "
        "ones reads otherwise than the rest: another skin, response or shape of the body."
    )
    if data.validation is not None:
        words += (
            " Right: from the points of the held-out contacts to where their readings put them, "
            "enlarged. Good: short lines in random directions; lines of neighbours in one "
            "direction are an error of the contact points or of the body."
        )
    return _save(
        folder,
        RESIDUALS,
        maps.residuals(data),
        "Residuals over the body",
        words + _projection_note(data),
        "Map of the residuals of the taxels, and of held-out contacts",
    )


DRAWN = (
    force, response, estimates, errors, uncertainty, coverage, residuals, iterations, accuracy_time
)  # fmt: skip
"""The figures, in the order of the page."""
EARLY = "force", "response", "estimates", "uncertainty", "coverage"
"""Figures of a simulated recording that need no other method."""
BESIDE = "iterations", "estimates", "coverage", "residuals"
"""Figures that are drawn in a second process: they take as long as the others."""
