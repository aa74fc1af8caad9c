"""What an effect may know when it is built."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from ..core.provenance import random_stream
from ..core.se3 import Array

if TYPE_CHECKING:
    from ..contact.reading import ReadingModel
    from ..geometry.body import Body
    from ..skin.skin import Skin


@dataclass(frozen=True)
class Context:
    """What an effect may know when it is built."""

    seed: int
    """Seed of the run."""
    peak_pressure: float
    """Peak contact pressure p_0 at the reference force, Pa."""
    contact_radius: float
    """Contact radius a at the reference force, m."""
    force: float
    """Reference force, N."""
    indenter_radius: float
    """m."""
    indenter_position: Array
    """Centre (3,), world, m."""
    shear_modulus: float
    """Of the skin, G = E / (2 (1 + nu)), Pa."""
    poisson: float
    """Poisson's ratio of the skin."""
    period: float
    """Time between frames, s."""
    speed: float
    """Speed of the contact over the skin, m/s."""
    skin: Skin = field(repr=False)
    body: Body = field(repr=False)
    reading_model: ReadingModel
    """How contacts become pressures where no effect changes it."""
    pose: Callable[[Array], Array] = field(repr=False)
    """Configurations (k, n) -> T_w_body (k, 4, 4)."""
    postures: Callable[[], Array] = field(repr=False)
    """Configurations (k, n) in which an arm may hold the skin on the indenter, on any path."""
    joints: int = 0
    """Number of joints; 0 where the body moves without an arm."""

    def stream(self, name: str) -> np.random.Generator:
        """The random stream of the effect `name`."""
        return random_stream(self.seed, f"effect/{name}")

    def reading_error_bound(self, relative: float) -> float:
        """How far, m, a taxel may be misplaced by readings that are off by `relative` p_0 at most.

        Least squares shift it by sum(s e) / sum(s^2) <= max|e| sum|s| / sum(s^2), s the slopes of
        the readings. The last ratio is about a / p_0 where contacts lie all over the patch; at a
        border of the exploration it is more, and twice that is taken.
        """
        return 2.0 * relative * self.contact_radius

    def model_error_bound(self, other: ReadingModel) -> float:
        """How far, m, where taxels read what `other` says: from the reading that differs most."""
        curvature = self.body.closest(self.skin.positions).curvature
        return self.reading_error_bound(
            self.reading_model.max_difference(other, self.force, curvature)
        )

    def force_error_bound(self, force: float) -> float:
        """How far, m, by a force off by `force`, N: p_0 and a go with its cube root (Hertz)."""
        return 2.0 / 3.0 * force / self.force * self.contact_radius
