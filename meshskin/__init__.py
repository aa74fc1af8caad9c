"""meshskin: self-calibration of robot skin on any body mesh.

Simulate how a skin-covered body presses on an indenter, find every taxel's pose from the recording,
and say how certain it is. Names are loaded when they are used, so that the import is quick.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .adaptive import adapt
    from .belief import Belief
    from .estimation.calibrate import calibrate
    from .estimation.calibration import Calibration
    from .estimation.posegraph import PoseGraph
    from .exploration import explore
    from .geometry.body import Body
    from .geometry.compare import compare
    from .geometry.lint import lint
    from .geometry.skin import Skin
    from .motion.arm import Arm
    from .motion.law import Law
    from .motion.path import Exploration
    from .physics import contact
    from .physics.indenter import Indenter
    from .physics.material import Material
    from .presses import press
    from .recording import Recording, RecordingWriter
    from .scene import Scene
    from .scene_parts import Readout
    from .simulation import simulate
    from .study.budget import budget
    from .study.cost import cost
    from .study.sweep import Study
    from .tuning.tune import tune

_HOMES = {
    "Arm": "motion.arm",
    "Belief": "belief",
    "Body": "geometry.body",
    "Calibration": "estimation.calibration",
    "Exploration": "motion.path",
    "Indenter": "physics.indenter",
    "Law": "motion.law",
    "Material": "physics.material",
    "PoseGraph": "estimation.posegraph",
    "Readout": "scene_parts",
    "Recording": "recording",
    "RecordingWriter": "recording",
    "Scene": "scene",
    "Skin": "geometry.skin",
    "Study": "study.sweep",
    "adapt": "adaptive",
    "budget": "study.budget",
    "calibrate": "estimation.calibrate",
    "compare": "geometry.compare",
    "cost": "study.cost",
    "explore": "exploration",
    "lint": "geometry.lint",
    "press": "presses",
    "simulate": "simulation",
    "tune": "tuning.tune",
}

__all__ = [
    "Arm",
    "Belief",
    "Body",
    "Calibration",
    "Exploration",
    "Indenter",
    "Law",
    "Material",
    "PoseGraph",
    "Readout",
    "Recording",
    "RecordingWriter",
    "Scene",
    "Skin",
    "Study",
    "adapt",
    "budget",
    "calibrate",
    "compare",
    "contact",
    "cost",
    "explore",
    "lint",
    "press",
    "simulate",
    "tune",
]


def __getattr__(name: str) -> Any:
    if name == "contact":
        return import_module(".physics.contact", __name__)
    if name not in _HOMES:
        raise AttributeError(f"module 'meshskin' has no attribute {name!r}")
    return getattr(import_module(f".{_HOMES[name]}", __name__), name)


def __dir__() -> list[str]:
    return sorted(__all__)
