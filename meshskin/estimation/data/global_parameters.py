"""Unknowns shared by all readings: the contact modulus, the force, where the contacts are.

e = ln(E* / nominal), h the force's scale and b its offset, F_true = exp(h) F + b; an indenter
offset, world frame, and a body offset (translation, rotation), body frame (contacts.py).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ...core.errors import UnknownNameError
from ...core.se3 import Array

SIZES = {"modulus": 1, "force_scale": 1, "force_offset": 1, "indenter_offset": 3, "body_offset": 6}
"""Shared unknowns and their numbers."""
LOCAL = ("gain", "offset")
"""Unknowns of each taxel beside its position."""
PRIORS = {
    "modulus": 1.0,
    "force_scale": 0.3,
    "force_offset": 0.3,
    "indenter_offset": 5e-3,
    "body_offset": 5e-3,
    "gain": 0.3,
    "offset": 0.3,
}
"""Standard deviations before any data: logarithms of modulus, force scale and gain; offsets of the
force in reference forces, of the pressure in reference peaks, of indenter and body in m."""
ROTATION = 10.0
"""Standard deviation of a body's rotation, rad, for every m of its translation's."""


@dataclass(frozen=True)
class GlobalParameters:
    """The declared shared unknowns s (ks,), in SI units and logarithms, and their priors."""

    names: tuple[str, ...]
    sigma: Array
    """Standard deviations (ks,) of s about zero before any data."""
    local_names: tuple[str, ...] = ()
    """Those of "gain" and "offset" that every taxel has."""
    local_sigma: tuple[float, ...] = ()
    """Their priors: of ln gain, and of the offset in Pa."""

    @property
    def columns(self) -> dict[str, slice]:
        """Where each unknown is in s."""
        ends = np.cumsum([SIZES[name] for name in self.names])
        return {n: slice(e - SIZES[n], e) for n, e in zip(self.names, map(int, ends), strict=True)}

    @property
    def labels(self) -> tuple[str, ...]:
        """A name (ks,) for every entry of s."""
        axes = ("x", "y", "z", "rotation x", "rotation y", "rotation z")
        return tuple(
            name if SIZES[name] == 1 else f"{name} {axis}"
            for name in self.names
            for axis in axes[: SIZES[name]]
        )

    @property
    def moving(self) -> bool:
        """Whether contact points move."""
        return "indenter_offset" in self.names or "body_offset" in self.names

    def prior_words(self) -> tuple[str, ...]:
        """Each prior in words."""
        sigma = {name: float(self.sigma[at.start]) for name, at in self.columns.items()}
        sigma |= zip(self.local_names, self.local_sigma, strict=True)
        words = {
            "modulus": "E* within a factor {:.3g} of its nominal value (1 sigma)",
            "force_scale": "force within a factor {:.3g} of the measured one (1 sigma)",
            "force_offset": "force offset 0 +- {:.3g} N",
            "indenter_offset": "indenter offset 0 +- {:.3g} m",
            "body_offset": "body offset 0 +- {:.3g} m",
            "gain": "gain of each taxel within a factor {:.3g} of 1 (1 sigma)",
            "offset": "offset of each taxel 0 +- {:.3g} Pa",
        }
        return tuple(
            text.format(np.exp(sigma[name]) if "factor" in text else sigma[name])
            for name, text in words.items()
            if name in sigma
        )

    def unlike(self, peak: float) -> GlobalParameters:
        """The same with a gain and an offset of each taxel, where they are not declared under the
        usual priors; `peak`, Pa, is that of reference.
        """
        sigma = {"gain": PRIORS["gain"], "offset": PRIORS["offset"] * peak}
        sigma |= zip(self.local_names, self.local_sigma, strict=True)
        return replace(self, local_names=LOCAL, local_sigma=tuple(sigma[name] for name in LOCAL))

    def value(self, name: str, s: Array, missing: float = 0.0) -> float:
        """The entry of a scalar unknown, `missing` where it is not declared."""
        return float(s[self.columns[name]][0]) if name in self.names else missing


def declared(
    unknown: tuple[str, ...], priors: Mapping[str, float], force: float, peak: float
) -> GlobalParameters:
    """The unknowns that a belief declares; `force`, N, and `peak`, Pa, are those of reference.

    Raises UnknownNameError for a name that is none.
    """
    for name in (*unknown, *priors):
        if name not in PRIORS:
            raise UnknownNameError("unknown of a belief", name, PRIORS)
    unit = {"force_offset": force, "offset": peak}
    prior = {name: priors.get(name, PRIORS[name]) * unit.get(name, 1.0) for name in PRIORS}
    names = tuple(name for name in SIZES if name in unknown)
    sigma = [np.full(SIZES[name], prior[name]) for name in names]
    if "body_offset" in names:
        sigma[names.index("body_offset")][3:] *= ROTATION
    local = tuple(name for name in LOCAL if name in unknown)
    return GlobalParameters(
        names, np.concatenate([*sigma, np.empty(0)]), local, tuple(prior[name] for name in local)
    )


MODULUS = GlobalParameters(("modulus",), np.ones(1))
"""The modulus alone, as by default."""
