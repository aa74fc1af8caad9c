"""Effects: deviations of a real skin, sensor or robot from the ideal scene.

Each effect is a frozen dataclass in a module of its own, which is imported when the effect is first
named. An effect that is off is absent: the loop has no branch for it and no random number is drawn.
Each effect draws from its own random stream, derived from the seed and its name, so that switching
one on or off does not change the noise of another. A new effect is one new module here and one line
in `base.NAMES`, or, in another package, one entry point in the group "meshskin.effects":
`name = "module:Class"`.
"""

from .base import (
    NAMES,
    STAGES,
    BaseEffect,
    Context,
    Effect,
    FrameTransform,
    NoiseEffect,
    PressureTransform,
    check_effect,
)
from .frames import EffectClock, Frames, PressureField
from .pipeline import EffectPipeline, build, ordered
from .registry import every_name, find, from_table, registered

__all__ = [
    "NAMES", "STAGES", "BaseEffect", "Context", "Effect", "EffectClock", "EffectPipeline",
    "FrameTransform", "Frames", "NoiseEffect", "PressureField", "PressureTransform", "build",
    "check_effect", "every_name", "find", "from_table", "ordered", "registered",
]  # fmt: skip
