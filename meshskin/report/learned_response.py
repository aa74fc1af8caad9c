"""The learned response: its figure, and what it says in words."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from . import theme
from .markup import SavedFigure, paragraphs, saved_figure
from .plane import MM

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ..core.arrays import Array
    from ..estimation.result import LearnedResponse

NAME = "response"
"""Name of the figure's files."""
TITLE = "Learned response of the taxels"
CAPTION = (
    "Left: reading of a taxel against its distance from the contact point, at the median force and "
    "before the compression of strong readings; the contact model that it corrects is scaled to "
    "the same height. Right: the reading against the level before compression. Bands: ± 2 standard "
    "deviations, with that of the scale, which profile and compression share. A contact model "
    "outside the band does not hold for this skin."
)
NOT_KNOWN = (
    "Not in this response: delays, patches that are not round, and, from raw readings, "
    "pressures. Where all forces are equal, the exponents in the force rest on their priors."
)
SIGMAS = 2.0
"""Half width of the bands, in standard deviations."""


@theme.styled
def figure(response: LearnedResponse) -> Figure:
    """The learned profile beside the model's, and the reading over the level, with their bands."""
    unit, scale = ("kPa", 1e-3) if response.unit_name == "Pa" else (response.unit_name, 1.0)
    made = theme.new_figure(9.0, 3.4)
    profile, curve = (theme.add_axes(made, x, 0.55, 3.5, 2.5) for x in (0.75, 5.25))
    distance, level = MM * response.distance, scale * response.level

    def band(axes: Axes, x: Array, y: Array, sigma: Array) -> None:
        low, high = scale * (y - SIGMAS * sigma), scale * (y + SIGMAS * sigma)
        axes.fill_between(x, low, high, color=theme.ESTIMATE, alpha=0.2, lw=0, label="± 2 sigma")
        axes.plot(x, scale * y, color=theme.ESTIMATE, lw=1.5, label="learned")

    band(profile, distance, response.profile, response.profile_sigma)
    band(curve, level, response.reading, response.reading_sigma)
    dashed: dict[str, Any] = {"color": theme.WARNING, "lw": 1.0, "ls": "--"}
    height = scale * float(np.max(response.profile) / np.max(response.model))
    profile.plot(distance, height * response.model, label="contact model", **dashed)
    curve.plot(level, level, label="no compression", **dashed)
    profile.set(
        xlabel="distance from the contact point (mm)",
        ylabel=f"level before compression ({unit})", title="Profile",
    )  # fmt: skip
    curve.set(
        xlabel=f"level before compression ({unit})", ylabel=f"reading ({unit})",
        title="Reading of a level",
    )  # fmt: skip
    profile.set_xlim(0.0, distance[-1])
    curve.set_xlim(0.0, level[-1])
    curve.set_ylim(bottom=0.0)
    profile.legend(loc="upper right")
    curve.legend(loc="upper left")
    return made


def section(
    response: LearnedResponse | None, pictures: Sequence[SavedFigure]
) -> dict[str, list[str]]:
    """The section about a learned response; none where the contact model's was used."""
    if response is None:
        return {}
    words = ". ".join(f"{text[0].upper()}{text[1:]}" for text in response.describe())
    lines = (
        f"The response was learned together with the taxels. {words}.",
        NOT_KNOWN,
    )
    return {TITLE: [paragraphs(*lines), *(saved_figure(p) for p in pictures if p.png.stem == NAME)]}
