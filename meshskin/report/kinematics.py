"""The section about the robot's kinematics: heights of the contacts, and residuals by joint."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from .data import ReportData
from .markup import paragraphs, table
from .theme import significant

TITLE = "Kinematics"


def sections(data: ReportData) -> dict[str, list[str]]:
    """The section about contacts that follow from joint angles; none for others."""
    given = data.metrics.get("kinematics")
    if not isinstance(given, Mapping):
        return {}
    rows = []
    for name, values in given["joints"].items():
        offset = values["offset_rad"]
        stated = "not declared"
        if offset is not None:
            value, sigma = np.degrees(offset)
            stated = f"{value:.3f} ± {significant(float(sigma))}"
        error = significant(float(np.degrees(values["error_rad"])))
        rows.append((name, stated, error, f"{values['explained']:.0%}", f"{values['chance']:.2g}"))
    header = (
        "joint", "offset (deg)", "error that varies with the angle (deg rms)",
        "explains of the heights left", "by chance",
    )  # fmt: skip
    words = (
        f"Contacts lie {significant(given['height_before_mm'])} mm off the body before the "
        f"estimate, {significant(given['height_mm'])} mm after it. A joint whose error varies with "
        "its angle, by an eccentric encoder or a bent link, would explain a part of what is left "
        "that chance does not."
    )
    return {TITLE: [paragraphs(words), table(header, rows, numeric=(2, 3, 4))]}
