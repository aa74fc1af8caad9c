"""Results in words, for the page and for the terminal: E*, and the contact force."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from .theme import compact

if TYPE_CHECKING:
    from ..estimation.calibration import Calibration


def modulus_words(found: Calibration, between: str = "±") -> str:
    """E* of a calibration that has one, with its standard deviation, or that it was given;
    `between`: value and standard deviation."""
    assert found.modulus is not None
    value, sigma = found.modulus / 1e3, found.modulus_sigma
    if sigma is None:
        return f"{value:.6g} kPa, given"
    sigma /= 1e3
    decimals = max(1 - math.floor(math.log10(sigma)), 0) if 0 < sigma < math.inf else 3  # of sigma
    return f"{value:.{decimals}f} {between} {sigma:.2g} kPa"


def force_notes(force: Mapping[str, Any]) -> list[str]:
    """The contact force beside its mean, from the metrics: reference, settling, overshoot, error
    while sliding; what is not known is left out."""
    notes = [f"reference {compact(force['reference_n'])} N"] if "reference_n" in force else []
    if lighter := force.get("lighter_references_n"):
        forces = " and ".join(compact(one) for one in lighter)
        notes.append(f"contacts of {forces} N scaled to it")
    if (seconds := force.get("settling_s")) is not None:
        settles = f"settled in {compact(seconds * 1e3)} ms"
        notes.append(settles if np.isfinite(seconds) else "not settled before it slides")
    if force.get("overshoot") is not None:
        over = 100 * force["overshoot"]
        notes.append(f"overshoot {over:.1f} %" if over >= 0.05 else "no overshoot")
    if force.get("departure"):
        notes.append("left its reference later: see above")
    elif (sliding := force.get("disturbance")) is not None:
        notes.append(f"then within {max(100 * sliding, 0.1):.2g} %")
    return notes
