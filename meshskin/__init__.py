"""meshskin: self-calibration of robot skin on any body mesh.

Simulate how a skin-covered body presses on an indenter, find every taxel's pose from the recording,
and say how certain it is. Names are loaded when they are used, so that the import is quick.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from . import contact
    from .contact.indenter import Indenter
    from .contact.material import Material
    from .estimation.adaptive import adapt
    from .estimation.calibrate import calibrate
    from .estimation.calibration import Calibration
    from .estimation.posegraph import PoseGraph
    from .exploration.explore import explore
    from .geometry.body import Body
    from .recording.recording import Recording, RecordingWriter
    from .robot.arm import Arm
    from .scene.belief import Belief
    from .scene.scene import Scene
    from .scene.settings import Exploration, Law, Readout
    from .simulation.simulate import simulate
    from .simulation.static_contacts import press
    from .skin.compare import compare
    from .skin.lint import lint
    from .skin.skin import Skin
    from .study.sensitivity.budget import budget
    from .study.sensitivity.cost import cost
    from .study.sweep.study import Study
    from .tuning.tune import tune

_HOMES = {
    "Arm": "robot.arm",
    "Belief": "scene.belief",
    "Body": "geometry.body",
    "Calibration": "estimation.calibration",
    "Exploration": "scene.settings",
    "Indenter": "contact.indenter",
    "Law": "scene.settings",
    "Material": "contact.material",
    "PoseGraph": "estimation.posegraph",
    "Readout": "scene.settings",
    "Recording": "recording.recording",
    "RecordingWriter": "recording.recording",
    "Scene": "scene.scene",
    "Skin": "skin.skin",
    "Study": "study.sweep.study",
    "adapt": "estimation.adaptive",
    "budget": "study.sensitivity.budget",
    "calibrate": "estimation.calibrate",
    "compare": "skin.compare",
    "cost": "study.sensitivity.cost",
    "explore": "exploration.explore",
    "lint": "skin.lint",
    "press": "simulation.static_contacts",
    "simulate": "simulation.simulate",
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
        return import_module(".contact", __name__)
    if name not in _HOMES:
        raise AttributeError(f"module 'meshskin' has no attribute {name!r}")
    return getattr(import_module(f".{_HOMES[name]}", __name__), name)


def __dir__() -> list[str]:
    return sorted(__all__)
