"""Joint encoders: an offset of each joint, the same all the time, and noise in every frame.

The body's pose is computed from the angles q + offset + noise, and the contact with it. (The closed
loop itself runs on the true angles.)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ...config import quantity
from ...errors import ConfigError
from ...se3 import Array
from . import Context, Motion, Plain
from .frames import Frames


@dataclass(frozen=True)
class Encoder(Plain):
    """Errors of the recorded joint angles, as they show in the recorded contacts."""

    offset_spread: float = quantity("rad", 2e-4, least=0.0, most=1.0)
    """Standard deviation of the offsets."""
    noise_spread: float = quantity("rad", 5e-5, least=0.0, most=1.0)
    """Standard deviation of the noise."""

    name: ClassVar[str] = "encoder"
    stage: ClassVar[str] = "robot"
    cost: ClassVar[float] = 7e-8

    def bound(self, context: Context) -> float:
        """At 3 standard deviations, m, with a lever to every joint of twice the distance from the
        base to the indenter."""
        spread = np.hypot(self.offset_spread, self.noise_spread)
        lever = 2.0 * float(np.linalg.norm(context.indenter_position))
        return float(3.0 * spread * np.sqrt(context.joints) * lever)

    def build(self, context: Context) -> Motion:
        """A function; successive calls continue one stream. Raises ConfigError without an arm."""
        if not context.joints:
            raise ConfigError(
                "the effect encoder needs the joints of an arm", remedy='set loop.mode = "arm"'
            )
        stream = context.stream(self.name)
        offset = self.offset_spread * stream.standard_normal(context.joints)

        def centres(q: Array) -> Array:
            pose = context.pose(q)
            return np.einsum(
                "kji,kj->ki", pose[:, :3, :3], context.indenter_position - pose[:, :3, 3]
            )

        def misread(frames: Frames) -> Frames:
            noise = self.noise_spread * stream.standard_normal(frames.q.shape)
            shift = centres(frames.q + offset + noise) - centres(frames.q)
            return frames.moved(frames.centres + shift)

        return misread
