"""Which figures a run gets, and what is said under each."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from . import curves, maps, precision, theme
from .data import ReportData, readable
from .markup import Picture
from .plane import MM

if TYPE_CHECKING:
    from matplotlib.figure import Figure


ACCURACY_TIME = "accuracy_time"
"""Name of the figure that stands in a section of its own."""


def album(folder: Path, findings: ReportData) -> list[Picture]:
    """Draw and save every figure that the findings allow, in the order of the page."""
    drawn = (force, estimates, errors, uncertainty, coverage, iterations, accuracy_time)
    return [p for draw in drawn for p in [draw(folder, findings)] if p is not None]


def _keep(
    folder: Path, name: str, figure: Figure, title: str, caption: str, alt: str = ""
) -> Picture:
    png, svg = theme.save(figure, folder, name)
    return Picture(png, svg, title, caption, alt or f"{title}. {caption}")


def _plane_note(findings: ReportData) -> str:
    """A word of caution where the skin bends away from the plane that it is drawn on."""
    pose = findings.calibration.poses if findings.truth is None else findings.truth
    normals = np.asarray(pose)[:, :3, 2]
    normals = normals[np.isfinite(normals).all(axis=1)]
    outward = np.cross(*findings.plane.axes)
    least = float(np.min(normals @ outward, initial=1.0))
    if least < 0:
        return " The skin reaches around the body: its far side is drawn over the near one."
    if least < 0.5:
        return " The skin bends by more than 60 degrees: towards the rim this projection squeezes."
    return ""


def force(folder: Path, findings: ReportData) -> Picture | None:
    """Fig. 4: force against reference."""
    recording = findings.recording
    if recording is None or not len(recording.time):
        return None
    if recording.motion is not None and recording.motion.num_rows:
        column = {k: recording.motion.column(k).to_numpy() for k in ("time", "force", "reference")}
        time, values, goal = column["time"], column["force"], column["reference"]
    else:
        time, values = recording.time, recording.force
        reference = findings.metrics.get("force", {}).get("reference_n")
        reference = recording.metadata.get("force_reference_n", reference)
        goal = None if reference is None else float(reference)
    settling = findings.metrics.get("force", {}).get("settling_s")
    return _keep(
        folder,
        "fig4_force",
        curves.force(time, values, goal, settling=settling),
        "Force against reference over time (the paper's fig. 4)",
        "Left: the whole run. Middle: first touch and settling. Right: the force held while "
        "sliding, enlarged. Good: it settles in less than 0.1 s without a jump past the band, and "
        "never falls to zero afterwards.",
        "Contact force over time beside its reference",
    )


def estimates(folder: Path, findings: ReportData) -> Picture | None:
    """Fig. 5: estimates against truth."""
    if findings.truth is None:
        return None
    figure = maps.estimates(
        findings.where,
        findings.calibration.positions,
        disc_radius=findings.disc_radius,
        plane=findings.plane,
    )
    return _keep(
        folder,
        "fig5_estimates",
        figure,
        "Estimates against the truth (the paper's fig. 5)",
        "True discs at their size and estimated centres, on the tangent plane at the skin's centre "
        "seen from outside; the errors are enlarged as the legend says. Good: short error lines in "
        "random directions; lines that all point one way mean a shift of the whole skin."
        + _plane_note(findings),
        "Map of true discs with estimated centres and enlarged error lines",
    )


def errors(folder: Path, findings: ReportData) -> Picture | None:
    """The error histogram."""
    if not findings.errors:
        return None
    bound = findings.metrics.get("crlb_mm", {}).get("mean")
    bound = None if bound is None or not np.isfinite(bound) or bound <= 0 else bound / MM
    return _keep(
        folder,
        "errors",
        curves.errors({readable(k): v for k, v in findings.errors.items()}, bound),
        "Position errors of every method",
        "One count a taxel, on one logarithmic axis. Good: the joint estimate's errors lie about "
        "the Cramér-Rao expectation (dashed), the best mean error that these readings allow."
        if bound is not None
        else "One count a taxel, on one logarithmic axis. Good: further left.",
        "Histograms of position errors by method",
    )


def uncertainty(folder: Path, findings: ReportData) -> Picture | None:
    """The uncertainty map."""
    if not np.isfinite(findings.sigma).any():
        return None
    figure = maps.uncertainty(
        findings.calibration.positions, findings.covariances, plane=findings.plane
    )
    return _keep(
        folder,
        "uncertainty",
        figure,
        "Stated uncertainty of every taxel",
        "1-sigma ellipses of the estimated positions, enlarged as the legend says. Good: small, "
        "round and alike; long ones at the rim say in which direction the contact path missed "
        "them." + _plane_note(findings),
        "Map of 1-sigma ellipses by taxel",
    )


def coverage(folder: Path, findings: ReportData) -> Picture | None:
    """The coverage map."""
    if not np.isfinite(findings.where).any():
        return None
    path = None if findings.recording is None else findings.recording.points
    figure = maps.coverage(
        findings.where,
        findings.calibration.readings,
        path,
        disc_radius=findings.disc_radius,
        plane=findings.plane,
    )
    missing = int((~findings.touched).sum())
    lost = f" {missing} never touched cannot be drawn: their place is unknown."
    return _keep(
        folder,
        "coverage",
        figure,
        "Coverage of the exploration",
        "How many readings each taxel gave (colours on a logarithmic scale), and the path of the "
        "contact over the skin. Good: no cross, passes on both sides of every taxel, and no taxel "
        "far darker than its neighbours."
        + (lost if missing and findings.truth is None else "")
        + _plane_note(findings),
        "Map of readings by taxel with the contact path",
    )


def accuracy_time(folder: Path, findings: ReportData) -> Picture | None:
    """What this run's accuracy cost."""
    points = {
        readable(name): (seconds, float(np.nanmean(findings.errors[name])) * MM)
        for name, seconds in findings.estimating.items()
        if name in findings.errors and np.isfinite(findings.errors[name]).any()
    }
    if not points or not findings.seconds:
        return None
    bound = findings.metrics.get("crlb_mm", {}).get("mean")
    return _keep(
        folder,
        ACCURACY_TIME,
        precision.accuracy_time(points, findings.seconds, bound or None),
        "Accuracy against time, of this run",
        "Left: what each estimator that ran made of the same recording, and how long it took; "
        "further left and lower is better, and none can be expected below the dashed line. Right: "
        "where the run's time went.",
        "Mean error against seconds of each estimator, and seconds of each stage",
    )


def iterations(folder: Path, findings: ReportData) -> Picture | None:
    """Fig. 6-8: the three panels for the page, and each as a file of its own."""
    run = findings.iterations
    if run is None:
        return None

    def draw(only: int | None) -> Figure:
        reference = "true taxel" if run.known else "end"
        return maps.iterations(
            run.over, run.steps, plane=findings.plane, only=only, reference=reference
        )

    goal = "truth" if run.known else "end"
    singles = (theme.save(draw(k), folder, f"fig{6 + k}_iteration") for k in range(3))
    also = tuple(file for pair in singles for file in pair)
    start = "True displacements of neighbours with noise added, every taxel started at one point. "
    picture = _keep(
        folder,
        "fig6-8_iterations",
        draw(None),
        "Pose-graph estimates along the iterations (the paper's fig. 6 to 8)",
        (start if run.demonstration else "")
        + f"Of {len(run.steps)} sets of estimates the first, the one nearest to half way and the "
        f"last. The means above are distances in space from the {goal}; the map shows their part "
        "along the skin. Good: in the last panel every estimate lies inside or beside its ring.",
        "Maps of the estimates at the first, middle and last iteration",
    )
    return replace(picture, also=also)
