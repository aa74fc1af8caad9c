"""Global parameters s, which all readings share: contact modulus, force, pose of the contacts.

e = ln(E* / nominal); scale h and offset b of the force, F_true = exp(h) F + b; an indenter offset
in the world frame and a body offset (translation, rotation) in the body frame (joint/contacts.py);
drag, the distance of the patches behind the moving contacts; friction, the shear of the skin at
which contacts begin to slide (joint/friction.py);
whitened entries u of the unknowns that move contacts (scene/contact_motion.py).
Each taxel may have nuisance parameters of its own: ln gain, offset, the offset's drift, and skew,
the distance of the patches behind the contacts when its channel is read.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np

from ...contact.learned import PROFILE_SIZE
from ...core.arrays import Array, spread_rows
from ...core.errors import UnknownNameError
from ...core.se3 import TURN_PER_METRE
from ...scene.contact_motion import ContactMotion

DRIFT_SIZE = 6
"""Entries of a drift that all taxels share: Legendre polynomials of the time from the first degree
on. They leave 0.8 % of the range of one period of a sine, and less of warming."""
DRIFTS = ("gain_drift", "offset_drift", "force_drift")
"""Drifts of the logarithm of the gain and of the offset of all taxels, and of the logarithm of the
true over the measured forces, estimated where the readings show them."""
PARAMETERS: dict[str, tuple[int, float, str]] = {
    "modulus": (1, 1.0, "E* within a factor {:.3g} of its nominal value (1 sigma)"),
    "force_scale": (1, 0.3, "force within a factor {:.3g} of the measured one (1 sigma)"),
    "force_offset": (1, 0.3, "force offset 0 +- {:.3g} N"),
    "indenter_offset": (3, 5e-3, "indenter offset 0 +- {:.3g} m"),
    "body_offset": (6, 5e-3, "body offset 0 +- {:.3g} m"),
    "drag": (1, 1e-3, "patches 0 +- {:.3g} m behind the moving contacts"),
    "friction": (1, 1e-3, "contacts slide from a shear of the skin of 0 +- {:.3g} m on"),
    "patch_shift": (
        1, 1.0, "patches displaced 0 +- {:.3g} times as a foundation of springs has them",
    ),
    "scale": (1, 0.5, "readings within a factor {:.3g} of the nominal pressures (1 sigma)"),
    "exponents": (3, 0.1, "exponents of the patch in the load within {:.3g} of the model's"),
    "aspect": (1, 0.3, "ratio of the semi-axes, as an exponent of the model's, within {:.3g} of 1"),
    "compression": (1, 0.3, "compression of strong readings 0 +- {:.3g}"),
    "profile": (
        PROFILE_SIZE, 0.1, "pressure profile within {:.3g} of the model's peak (1 sigma, smooth)",
    ),
    "hysteresis": (2, 1.0, "share of hysteresis 0 +- {:.3g}"),
    "crosstalk": (1, 0.3, "share of its neighbours' pressures in a reading 0 +- {:.3g}"),
    "creep": (3, 1.0, "share of creep 0 +- {:.3g}"),
    "gain_drift": (DRIFT_SIZE, 0.1, "drift of the gain of all taxels 0 +- {:.3g}"),
    "offset_drift": (
        DRIFT_SIZE, 0.1, "drift of the offset of all taxels, in nominal peaks, 0 +- {:.3g}",
    ),
    "force_drift": (DRIFT_SIZE, 0.1, "drift of ln of the forces 0 +- {:.3g}"),
    "gain": (0, 0.3, "gain of each taxel within a factor {:.3g} of 1 (1 sigma)"),
    "offset": (0, 0.3, "offset of each taxel 0 +- {:.3g} Pa"),
    "drift": (0, 0.3, "drift of each taxel's offset during the recording 0 +- {:.3g} Pa"),
    "skew": (0, 1e-3, "patches 0 +- {:.3g} m behind the contacts when a taxel is read"),
}  # fmt: skip
"""Number of entries of each global parameter, 0 of those of each taxel; the default standard
deviation of its prior; and the prior in words.

Deviations are of the logarithms of modulus, force scale and gain; of the force offset in reference
forces, of the pressure offset and its drift over the recording in reference peak pressures, of
indenter and body offset, drag and skew in m. Weak on purpose: `Belief.priors` replaces them."""
SIZES = {name: size for name, (size, _, _) in PARAMETERS.items() if size}
"""Number of entries of each global parameter, but for the contact motion."""
PRIORS = {name: sigma for name, (_, sigma, _) in PARAMETERS.items()}
"""Default standard deviations of the priors."""
MOTION = "contact_motion"
"""Global parameter of as many entries as the belief's contact motion has."""
MOVES = ("indenter_offset", "body_offset", "drag", "friction", "patch_shift", MOTION)
"""Global parameters that move the recorded contacts, not the readings of a contact in its place."""
NUISANCE = ("gain", "offset", "drift", "skew")
"""Parameters of each taxel beside its position."""
OWN_DEPARTURES = ("drift", "skew")
"""Those that are estimated only where the readings show them."""
PRIOR_SIGMAS = 4.0
"""Distance of a global parameter from zero, in standard deviations of its prior, from which it is
not plausible: 6e-5 by chance."""
LEARNED = ("modulus", "scale", "exponents", "aspect", "compression", "profile")
"""Global parameters of a learned response. "modulus" is then the size of the patch, "scale" the
amplitude of the readings, both relative to the model's; the ratio of the semi-axes is the
model's to the power 1 + "aspect". That of a half-space is about the power 2/3 of the relative
principal curvatures' ratio, that of a thin layer 1/2: an aspect of -1/4."""
ELECTRONICS = ("hysteresis", "crosstalk", "creep")
"""Further ones, estimated where the readings show them (joint/electronics.py)."""
ERROR_EXPONENT = "exponents of the radius in force errors"
"""Label of the exponent of sizes in a contact's error of ln F, beyond the model's. Without such
errors there is nothing to determine."""
DEPARTURES = (*ELECTRONICS, *DRIFTS, *OWN_DEPARTURES)
"""What makes a reading depend on its taxel's past, on its neighbours or on the time."""
LEARNED_PRIORS = {"modulus": 0.5, "scale": 0.5}
"""Their priors that differ from PRIORS: readings in a unit of their own say nothing about E*."""
MIN_KEPT = 0.05
"""Least part of a reading at the typical level that compression leaves: no sensor has less."""
LEARNED_ONLY = (*LEARNED[1:], *DEPARTURES)
"""Parameters that a learned response estimates of itself, and a contact model does not have."""
IN_GROUP = " of group {}"
"""What follows the name of a parameter of the second and further groups of taxels."""
LOGARITHMS = ("modulus", "force_scale", "scale", "gain", "mesh_scale")
"""Parameters, also of a contact motion, that are natural logarithms of a factor."""
UNITS = (
    {"force_offset": "N", "joint_offset": "rad"}
    | dict.fromkeys(("joint_delay", "clock_offset"), "s")
    | dict.fromkeys(
        ("exponents", "aspect", "compression", "force_scatter", "hysteresis", "crosstalk"), ""
    )
    | dict.fromkeys(("profile", "creep", "patch_shift", *DRIFTS), "")
)
"""Units of global parameters that are neither lengths nor angles nor logarithms."""


@dataclass(frozen=True)
class GlobalParameters:
    """The declared global parameters s (ks,), in SI units and logarithms, with their priors."""

    names: tuple[str, ...]
    sigma: Array
    """Prior standard deviations (ks,) of s about zero."""
    nuisance_names: tuple[str, ...] = ()
    """Names, of NUISANCE, of the parameters that every taxel has."""
    nuisance_sigma: tuple[float, ...] = ()
    """Their prior standard deviations: of ln gain, and of the offset and its drift in Pa."""
    motion: ContactMotion | None = None
    """The belief's motion of the contacts, if MOTION is among the names."""
    groups: int = 1
    """Groups of taxels, each of which has parameters of LEARNED of its own, one after the other."""

    @property
    def columns(self) -> dict[str, slice]:
        """The entries of s of each parameter, those of all groups together."""
        sizes = [self._size(name) for name in self.names]
        ends = np.cumsum(sizes)
        return {
            name: slice(int(end) - size, int(end))
            for name, size, end in zip(self.names, sizes, ends, strict=True)
        }

    def columns_of(self, group: int) -> dict[str, slice]:
        """The entries of s of each parameter of the taxels of a group."""
        found = self.columns
        if self.groups > 1:
            for name in found.keys() & set(LEARNED):
                start = found[name].start + group * SIZES[name]
                found[name] = slice(start, start + SIZES[name])
        return found

    def _size(self, name: str) -> int:
        if name == MOTION and self.motion is not None:
            return self.motion.size
        return SIZES[name] * (self.groups if name in LEARNED else 1)

    @property
    def labels(self) -> tuple[str, ...]:
        """A name (ks,) for every entry of s."""
        axes = ("x", "y", "z", "rotation x", "rotation y", "rotation z")
        entries = {
            "exponents": (
                "of the radius",
                "of the peak",
                ERROR_EXPONENT.removeprefix("exponents "),
            ),
            "hysteresis": ("share", "width"),
            "creep": ("share", "time constant", "lift"),
            **dict.fromkeys(DRIFTS, tuple(str(k + 1) for k in range(DRIFT_SIZE))),
            "profile": tuple(str(k) for k in range(1, PROFILE_SIZE + 1)),
            MOTION: tuple(
                str(k + 1) for k in range(0 if self.motion is None else self.motion.size)
            ),
        }
        return tuple(
            (name if SIZES.get(name) == 1 else f"{name} {entry}")
            + (IN_GROUP.format(group + 1) if group else "")
            for name in self.names
            for group in range(self.groups if name in LEARNED else 1)
            for entry in entries.get(name, axes)[: SIZES.get(name, self._size(name))]
        )

    def start(self) -> Array:
        """The entries of s (ks,) at which an estimate begins: where the contacts were computed."""
        s = np.zeros(len(self.sigma))
        if self.motion is not None:
            s[self.columns[MOTION]] = self.motion.about
        return s

    def named(self, s: Array, covariance: Array) -> dict[str, tuple[float, float]]:
        """Value and standard deviation of each global parameter at s (ks,) with a covariance
        (ks, ks); those of the contact motion by the names of its unknowns."""
        sigma = np.sqrt(np.diag(covariance))
        found = {
            label: (float(value), float(deviation))
            for label, value, deviation in zip(self.labels, s, sigma, strict=True)
        }
        if self.motion is None:
            return found
        at = self.columns[MOTION]
        for label in self.labels[at]:
            del found[label]
        return found | self.motion.unknowns(s[at], covariance[at, at])

    def grouped(self, groups: int) -> tuple[GlobalParameters, np.ndarray]:
        """These parameters, of one group, for several; and the row of s (ks,) whose value and prior
        each of theirs has."""
        row, columns = np.arange(len(self.sigma)), self.columns
        repeated = [
            np.tile(row[columns[name]], groups if name in LEARNED else 1) for name in self.names
        ]
        rows = np.concatenate([row[:0], *repeated])
        return replace(self, sigma=self.sigma[rows], groups=groups), rows

    def without(self, names: Collection[str]) -> tuple[GlobalParameters, np.ndarray]:
        """These parameters but for the global ones `names`, and the rows of s that are left."""
        kept, columns = tuple(n for n in self.names if n not in names), self.columns
        row = np.arange(len(self.sigma))
        rows = np.concatenate([row[:0], *(row[columns[name]] for name in kept)])
        motion = None if MOTION in names else self.motion
        return replace(self, names=kept, sigma=self.sigma[rows], motion=motion), rows

    @property
    def move_contacts(self) -> bool:
        """Whether the contact points depend on s."""
        return any(name in MOVES for name in self.names)

    def describe_priors(self) -> tuple[str, ...]:
        """One sentence for each prior."""
        sigma = {name: float(self.sigma[at.start]) for name, at in self.columns.items()}
        sigma |= zip(self.nuisance_names, self.nuisance_sigma, strict=True)
        return tuple(
            text.format(np.exp(sigma[name]) if name in LOGARITHMS else sigma[name])
            for name, (_, _, text) in PARAMETERS.items()
            if name in sigma
        )

    def with_nuisance(self, peak: float, more: Collection[str] = ()) -> GlobalParameters:
        """These parameters, and a gain and an offset of each taxel, and `more` of NUISANCE.

        Those that are not declared get the default priors; `peak`, Pa, is the reference peak.
        """
        own = "gain", "offset", *more
        sigma = {name: PRIORS[name] * nuisance_unit(name, peak) for name in own}
        sigma |= zip(self.nuisance_names, self.nuisance_sigma, strict=True)
        names = tuple(name for name in NUISANCE if name in sigma)
        values = tuple(sigma[name] for name in names)
        return replace(self, nuisance_names=names, nuisance_sigma=values)

    def of_taxels(
        self, values: Array, sigma: Array, unit: float, rows: np.ndarray, count: int
    ) -> dict[str, Array]:
        """Nuisance parameters with their standard deviations (count, 2), by name, of all taxels:
        values and sigma (r, q), pressures in units of `unit`, Pa, of the taxels `rows` (r,)."""
        units = [nuisance_unit(name, unit) for name in self.nuisance_names]
        pairs = np.stack([values * units, sigma * units], axis=2)
        every = spread_rows(pairs, rows, count, [np.nan, np.inf])
        return {name: every[:, k] for k, name in enumerate(self.nuisance_names)}

    def value(self, name: str, s: Array, group: int = 0) -> float:
        """The entry of a scalar parameter, of a group, in s (ks,); 0 if it is not declared."""
        return float(s[self.columns_of(group)[name]][0]) if name in self.names else 0.0


def nuisance_unit(name: str, pressure: float) -> float:
    """Unit of a parameter of NUISANCE where pressures are in units of `pressure`, Pa."""
    return pressure if name in ("offset", "drift") else 1.0


def declared_parameters(
    unknown: tuple[str, ...],
    priors: Mapping[str, float],
    force: float,
    peak: float,
    motion: ContactMotion | None = None,
) -> GlobalParameters:
    """The parameters that a belief declares `unknown`, and those of its contact motion.

    priors: standard deviations in place of PRIORS; force, N, and peak, Pa: the reference values.
    Raises UnknownNameError for a name that does not exist.
    """
    for name in (*unknown, *priors):
        if name not in PRIORS and (name != MOTION or motion is None):
            raise UnknownNameError("parameter of a belief", name, PRIORS)
    unit = {"force_offset": force, "offset": peak, "drift": peak}
    prior = {name: priors.get(name, PRIORS[name]) * unit.get(name, 1.0) for name in PRIORS}
    names = tuple(name for name in SIZES if name in unknown)
    sigma = [np.full(SIZES[name], prior[name]) for name in names]
    if "body_offset" in names:
        sigma[names.index("body_offset")][3:] *= TURN_PER_METRE
    nuisance = tuple(name for name in NUISANCE if name in unknown)
    if motion is not None:
        names, sigma = (*names, MOTION), [*sigma, np.ones(motion.size)]
    return GlobalParameters(
        names,
        np.concatenate([*sigma, np.empty(0)]),
        nuisance,
        tuple(prior[name] for name in nuisance),
        motion,
    )


MODULUS = GlobalParameters(("modulus",), np.ones(1))
"""The default: E* is the only global parameter."""


def natural_units(
    unknowns: Mapping[str, tuple[float, float]],
    modulus: float | None,
    modulus_sigma: float | None = None,
) -> dict[str, tuple[float, float, str]]:
    """Value, standard deviation and unit of each of `Calibration.unknowns` in natural units.

    modulus: the estimated E*, Pa; modulus_sigma: its standard deviation, where it is wider than by
    the readings.
    """
    out = {}
    for label, (value, sigma) in unknowns.items():
        name = label.split()[0]
        if label == "modulus" and modulus is not None:
            out[label] = modulus, modulus_sigma or modulus * sigma, "Pa"
        elif name in LOGARITHMS or label in ("hysteresis width", "creep time constant"):
            out[label] = float(np.exp(value)), float(np.exp(value)) * sigma, ""
        else:
            unit = UNITS.get(name, "rad" if "rotation" in label else "m")
            out[label] = value, sigma, unit
    return out
