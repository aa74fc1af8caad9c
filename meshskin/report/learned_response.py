"""The learned response: its figure, and what it says in words."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..estimation.result import ids_in_words
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
    "outside the band does not hold for this skin. The profile is not constrained to be positive: "
    "within the band a part below zero cannot be told from zero; beyond it, taxels at that "
    "distance read less than at rest. Taxels of another skin or amplifier have curves of their own."
)
NOT_KNOWN = (
    "Not in this response: delays, patches that are not round, and, from raw readings, "
    "pressures. Where all forces are equal, the exponents in the force rest on their priors."
)
SIGMAS = 2.0
"""Half width of the bands, in standard deviations."""


@theme.styled
def figure(response: LearnedResponse) -> Figure:
    """The learned profile beside the model's, and the reading over the level, with their bands, of
    each group of taxels."""
    unit, scale = ("kPa", 1e-3) if response.unit_name == "Pa" else (response.unit_name, 1.0)
    made = theme.new_figure(9.0, 3.4)
    profile, curve = (theme.add_axes(made, x, 0.55, 3.5, 2.5) for x in (0.75, 5.25))
    single, each = not response.others, response.each
    look: dict[str, Any]

    def band(axes: Axes, x: Array, y: Array, sigma: Array, look: dict[str, Any]) -> None:
        low, high = scale * (y - SIGMAS * sigma), scale * (y + SIGMAS * sigma)
        label = "± 2 sigma" if single else None
        axes.fill_between(x, low, high, color=look["color"], alpha=0.2, lw=0, label=label)
        axes.plot(x, scale * y, lw=1.5, **look)

    for one, color in zip(each, theme.PALETTE, strict=False):
        label = "learned" if single else f"taxels {ids_in_words(one.taxels)}"
        look = {"color": color, "label": label}
        band(profile, MM * one.distance, one.profile, one.profile_sigma, look)
        band(curve, scale * one.level, one.reading, one.reading_sigma, look)
    for one, color in zip(each, theme.PALETTE, strict=False):
        height = scale * float(np.max(one.profile) / np.max(one.model))
        look = {"color": theme.WARNING if single else color, "lw": 1.0, "ls": "--"}
        look["label"] = "contact model" if one is each[-1] else None
        profile.plot(MM * one.distance, height * one.model, **look)
    if min(float(one.profile.min()) for one in each) < 0.0:
        profile.axhline(0.0, color=theme.MUTED, lw=0.5)
    level = scale * np.concatenate([one.level for one in each])
    linear = np.array([0.0, level.max()])
    curve.plot(linear, linear, color=theme.WARNING, lw=1.0, ls="--", label="no compression")
    profile.set(
        xlabel="distance from the contact point (mm)",
        ylabel=f"level before compression ({unit})", title="Profile",
    )  # fmt: skip
    curve.set(
        xlabel=f"level before compression ({unit})", ylabel=f"reading ({unit})",
        title="Reading of a level",
    )  # fmt: skip
    profile.set_xlim(0.0, MM * max(one.distance[-1] for one in each))
    curve.set_xlim(0.0, level.max())
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
    lines = (f"The response was learned together with the taxels. {words}.", NOT_KNOWN)
    return {TITLE: [paragraphs(*lines), *(saved_figure(p) for p in pictures if p.png.stem == NAME)]}
