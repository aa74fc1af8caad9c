"""How the contacts of a recording move with unknowns of the robot: a table of sensitivities.

    x(u) = x_recorded + slopes root (u - about),   unknowns(u) = mean + root u,   u ~ N(0, I)

x is the indenter's centre in the body frame. The unknowns may be anything that moves it: offsets of
joints, the mount of the body on its link, the indenter's place, a delay between clocks. `root`
holds what is known of them before the readings: standard deviations on its diagonal, or the root of
a covariance where measurements other than the readings constrain them.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from ..core.arguments import check_array
from ..core.arrays import Array
from ..core.errors import ConfigError


@dataclass(frozen=True, eq=False)
class ContactMotion:
    """The unknowns (K,) that move the m contacts of a recording. Raises ConfigError."""

    labels: tuple[str, ...]
    """Name of each unknown (K,)."""
    sigma: Array
    """Their standard deviations (K,) before any measurement."""
    slopes: Array
    """(m, 3, K): displacement of the indenter's centre in the body frame, m, by each unknown."""
    mean: Array = field(default_factory=lambda: np.empty(0))
    """Their means (K,) before the readings; by default zero."""
    root: Array = field(default_factory=lambda: np.empty(0))
    """(K, k) with root root^T their covariance before the readings; by default of `sigma`."""
    about: Array = field(default_factory=lambda: np.empty(0))
    """The u (k,) at which the recording's contacts were computed; by default zero."""
    held: Array = field(default_factory=lambda: np.empty(0))
    """(K, h) with held held^T the further covariance, of directions that nothing determines: the
    unknowns stay at their means in these; by default there are none."""

    def __post_init__(self) -> None:
        names, count = ("slopes", "sigma", "mean", "root", "held", "about"), len(self.labels)
        given = {n: check_array(f"{n} of a contact motion", getattr(self, n)) for n in names}
        slopes, sigma = given["slopes"], given["sigma"]
        if slopes.shape[1:] != (3, count) or sigma.shape != (count,) or not np.all(sigma > 0):
            raise ConfigError(
                "a contact motion needs slopes (m, 3, K) and positive sigma (K,) of its K unknowns",
                value=f"shapes {slopes.shape} and {sigma.shape}",
                limit=f"K = {count}",
            )
        root = given["root"] if len(given["root"]) else np.diag(sigma)
        defaults = {"mean": np.zeros(count), "root": np.diag(sigma), "held": np.zeros((count, 0))}
        defaults["about"] = np.zeros(root.shape[-1:])
        for name, default in defaults.items():
            array = given[name] = given[name] if len(given[name]) else default
            if array.shape[:1] != default.shape[:1] or array.ndim != default.ndim:
                raise ConfigError(
                    f"{name} of a contact motion must fit its unknowns",
                    value=f"shape {array.shape}",
                    limit=f"shape {default.shape}",
                )
        for name, array in given.items():
            if not np.isfinite(array).all():
                raise ConfigError(f"{name} of a contact motion must be finite")
            object.__setattr__(self, name, array)

    @property
    def by_joints(self) -> bool:
        """Whether the contacts follow from joint angles: recorded ones move with the body alone."""
        return not self.labels[0].startswith("body_offset")

    @property
    def size(self) -> int:
        """Number k of entries of u."""
        return int(self.root.shape[1])

    def take(self, rows: np.ndarray) -> Self:
        """The motion of the contacts `rows` (m,) bool. Raises ConfigError if m differs."""
        if len(rows) != len(self.slopes):
            raise ConfigError(
                "a contact motion must have slopes of each contact of the recording",
                value=f"{len(self.slopes)} contacts",
                limit=f"{len(rows)} contacts",
            )
        return replace(self, slopes=self.slopes[rows])

    def displacements(self, u: Array) -> Array:
        """Displacements (m, 3), m, of the indenter's centre at u (k,)."""
        return np.asarray(self.slopes @ (self.root @ (u - self.about)))

    def covariance(self, covariance: Array) -> Array:
        """Covariance (K, K) of the unknowns, given that of u (k, k)."""
        return np.asarray(self.root @ covariance @ self.root.T + self.held @ self.held.T)

    def unknowns(self, u: Array, covariance: Array) -> dict[str, tuple[float, float]]:
        """Value and standard deviation of each unknown at u (k,) with a covariance (k, k)."""
        values = self.mean + self.root @ u
        sigma = np.sqrt(np.maximum(np.diag(self.covariance(covariance)), 0.0))
        found = zip(values, sigma, strict=True)
        return {n: (float(v), float(s)) for n, (v, s) in zip(self.labels, found, strict=True)}
