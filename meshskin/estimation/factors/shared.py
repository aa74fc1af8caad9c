"""Unknowns shared by all readings: the contact modulus, the force, where the contacts are.

    f = ln(F_true / F),  F_true = exp(h) F + b,  c = c_0 + B (s - s_0),

e = ln(E* / nominal), h the force's scale, b its offset; patches.py tells how the patches follow f
and e (on a half-space a ~ exp((f - e)/3), p_0 ~ exp((f + 2 e)/3)). B holds the moves of the
contact points under an indenter offset, world frame, and a body offset (translation, rotation),
body frame. Points are anchored anew on the surface, as the taxels are: B only speeds the way there.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ... import se3
from ...errors import CalibrationError, UnknownNameError
from ...physics.contact import Patches
from ...se3 import Array
from .patches import FOLLOW

if TYPE_CHECKING:
    from ...geometry.body import Body
    from ..measurements import Measurements

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
FAR = 20.0
"""Standard deviations of a prior at which it ends."""
FOOT_STEP = 1e-5
"""Step over which a contact point's moves are told, m."""


@dataclass(frozen=True)
class Shared:
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

    def value(self, name: str, s: Array, missing: float = 0.0) -> float:
        """The entry of a scalar unknown, `missing` where it is not declared."""
        return float(s[self.columns[name]][0]) if name in self.names else missing


def declared(
    unknown: tuple[str, ...], priors: Mapping[str, float], force: float, peak: float
) -> Shared:
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
    return Shared(
        names, np.concatenate([*sigma, np.empty(0)]), local, tuple(prior[name] for name in local)
    )


MODULUS = Shared(("modulus",), np.ones(1))
"""The modulus alone, as by default."""


@dataclass(frozen=True)
class Contacts:
    """m contacts as the shared unknowns say, and how they change with them."""

    points: Array
    """(m, 3), body frame, m."""
    normals: Array
    """(m, 3)."""
    directions: Array
    """Unit tangents (m, 3) along the patches' first semi-axes."""
    patches: Patches
    """Semi-axes, m, and peaks p_0, Pa, of m contacts."""
    shape: tuple[Array, ...]
    """Derivatives (m, ks) in s of what the contact model calls the shape (`patches.Means`)."""
    log_peak: Array
    """d ln p_0 / ds (m, ks)."""
    moves: Array | None
    """B (m, 3, ks); None where no contact moves."""

    @property
    def radii(self) -> Array:
        """Radii (m,), m, of the circles of the patches' areas."""
        return np.asarray(np.sqrt(self.patches.first * self.patches.second))

    @property
    def peaks(self) -> Array:
        """p_0 (m,), Pa."""
        return np.asarray(self.patches.peak)


@dataclass(frozen=True)
class Anchored:
    """The contacts anchored on the body's surface at `about`, values of s (ks,)."""

    shared: Shared
    data: Measurements
    about: Array
    moves: Array | None = None

    def at(self, s: Array) -> Contacts:
        """The contacts at s (ks,)."""
        data, shared, at = self.data, self.shared, self.shared.columns
        within, force = self._within(s), self._force(s)
        e, h = (shared.value(n, within) for n in ("modulus", "force_scale"))
        f = np.log(force / data.force)
        log_force = np.zeros((len(f), len(s)))
        if "force_scale" in at:
            log_force[:, at["force_scale"]] = (np.exp(h) * data.force / force)[:, None]
        if "force_offset" in at:
            log_force[:, at["force_offset"]] = 1 / force[:, None]
        patches, rates = FOLLOW[data.model.name](data, f, e)
        load = log_force  # of ln(F/E*)
        if "modulus" in at:
            load[:, at["modulus"]] = -1.0
        log_peak = rates.peak * load
        if "modulus" in at:
            log_peak[:, at["modulus"]] += 1.0
        points = (
            data.points if self.moves is None else data.points + self.moves @ (within - self.about)
        )
        return Contacts(
            points=points,
            normals=data.normals,
            directions=data.directions,
            patches=patches,
            shape=tuple(rate * load for rate in rates.shape),
            log_peak=log_peak,
            moves=self.moves,
        )

    def check(self, s: Array) -> None:
        """Raise ContactError where the contacts at s (ks,) leave the contact model's series."""
        data, e = self.data, self.shared.value("modulus", self._within(s))
        data.model.patches(
            force=self._force(s),
            curvature=data.curvature,
            indenter_radius=data.indenter_radius,
            effective_modulus=data.modulus * np.exp(e),
        )

    def _within(self, s: Array) -> Array:
        # Beyond its priors' far end a trial step of the optimiser changes no more.
        return np.clip(s, -FAR * self.shared.sigma, FAR * self.shared.sigma)

    def _force(self, s: Array) -> Array:
        """True forces (m,), N."""
        h, b = (self.shared.value(n, self._within(s)) for n in ("force_scale", "force_offset"))
        return np.maximum(np.exp(h) * self.data.force + b, 0.01 * self.data.force)


def anchored(shared: Shared, data: Measurements, body: Body, s: Array) -> Anchored:
    """The contacts on the surface at s (ks,): nearest to the indenter's centre, as moved by s.

    Raises CalibrationError if the indenter's offset is unknown and the headings are, too.
    """
    if not shared.moving:
        return Anchored(shared, data, s)
    at, centre = shared.columns, data.points + data.height[:, None] * data.normals
    into = np.zeros((len(centre), 3, len(s)))  # moves of the centre in the body frame
    moved = centre
    if "body_offset" in at:
        xi = s[at["body_offset"]]
        moved = moved @ se3.exp_so3(xi[3:]).T + xi[:3]
        into[:, :, at["body_offset"]] = np.concatenate(
            [np.broadcast_to(np.eye(3), (len(centre), 3, 3)), -se3.hat(moved - xi[:3])], axis=2
        )
    if "indenter_offset" in at:
        if data.headings is None:
            raise CalibrationError(
                "an unknown indenter offset needs the body's orientation in every contact",
                value="belief.headings = None",
                remedy="record qw qx qy qz of every contact, give belief.headings (m, 3, 3), world "
                "from body, or leave it out",
            )
        back = np.swapaxes(data.headings, 1, 2)
        moved = moved + back @ s[at["indenter_offset"]]
        into[:, :, at["indenter_offset"]] = back
    hit = body.closest(moved)
    steps = moved[:, None] + FOOT_STEP * np.eye(3)
    foot = body.closest(steps.reshape(-1, 3)).point.reshape(-1, 3, 3) - hit.point[:, None]
    moves = np.swapaxes(foot, 1, 2) / FOOT_STEP @ into
    # The recorded points are on the believed surface only as well as they were recorded.
    return Anchored(shared, data.on(hit), s, moves)
