"""Levels of the knobs that a request may turn, each tried on the path of a pilot run.

How far a level moves the taxels, as `cost` measures it, and what it takes. The estimator is no such
knob: all of them run in any case, and the joint estimate errs least.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from ...contact import BATCHED
from ...core.errors import ConfigError, ContactError, ReachError, SimulationError
from ...estimation.calibrate import calibrate
from ...estimation.joint.newton import NEWTON_TOLERANCE
from .numerical_error import Numerics, mean_mm
from .second_routes import geometry
from .setting import INTEGRATORS, Setting

if TYPE_CHECKING:
    from ...recording.recording import Recording
    from ...scene.belief import Belief
    from ...scene.scene import Scene

COARSER = (2, 5)
"""Steps of the loop, over the scene's own."""
TOLERANCES = (NEWTON_TOLERANCE, 1e-2, 1.0)
"""Newton decrements at which the estimate may rest."""
SPARED = 0.8
"""Part of the own level's seconds that a level that errs more may take: timings scatter."""
FINER = 4
"""Faces that are tried where the scene's own err too much, over those."""
FINE = 0.1
"""Part of the accuracy asked for that the scene's own surface may be off before finer ones are
tried: coarser ones would be fitted besides, and save nothing."""


@dataclass(frozen=True)
class Level:
    """One level of a knob."""

    changes: Mapping[str, Any] = field(default_factory=dict)
    """What it changes of a setting."""
    numerical_mm: float = 0.0
    """How far it moves the taxels, in what is simulated."""
    error_mm: float = 0.0
    """The same, in the estimate."""
    once: float = 0.0
    """Processor seconds of what depends on it: however long the run is, ..."""
    along: float = 0.0
    """... along the pilot's path, ..."""
    reading: float = 0.0
    """... and of the pilot's readings. Only what levels of one knob differ by is believed."""

    @property
    def shift_mm(self) -> float:
        """How far it moves the taxels in all."""
        return float(np.hypot(self.numerical_mm, self.error_mm))

    @property
    def seconds(self) -> float:
        """Processor seconds of the pilot."""
        return self.once + self.along + self.reading


def worth(levels: Sequence[Level]) -> tuple[Level, ...]:
    """The first, and of the others those that err less, or take less by more than chance."""
    own, *others = levels
    kept = [x for x in others if x.shift_mm < own.shift_mm or x.seconds < SPARED * own.seconds]
    return own, *kept


def loops(numerics: Numerics, scene: Scene, factors: Iterable[float]) -> tuple[Level, ...]:
    """Steps, by factors on the scene's own, and integrators, the scene's own first; those that the
    loop cannot take are left out.
    """
    own, out = scene.loop, []
    others = INTEGRATORS if own.mode == "arm" else ()
    for factor, integrator in product(factors, dict.fromkeys((own.integrator, *others))):
        try:
            loop = replace(own, dt=own.dt * factor, integrator=integrator)
            made = numerics.bare(scene.with_(loop=loop))
            begin = time.process_time()
            frames = numerics.drive(made)
        except (ConfigError, ContactError, ReachError, SimulationError):
            continue
        seconds = time.process_time() - begin
        moved = numerics.calibrate(numerics.read(made, frames)) - numerics.positions
        changes = {"dt": loop.dt, "integrator": integrator}
        out.append(Level(changes, mean_mm(moved), along=seconds))
    return tuple(out)


def models(numerics: Numerics, scene: Scene) -> tuple[Level, ...]:
    """Contact models that hold at every taxel at which the scene's own does, that one first."""
    curvature = scene.body.closest(scene.skin.positions).curvature
    own, out = scene.invalid_reasons(curvature) == "", []
    for name in sorted(BATCHED, key=lambda name: name != scene.model.name):
        made = numerics.scene.with_(contact=name)
        layer = scene.material.thickness is not None or scene.model.name == "layered"
        if (name == "layered" and not layer) or not np.all(
            (made.invalid_reasons(curvature) == "") | ~own
        ):
            continue
        begin = time.process_time()
        found = numerics.calibrate(numerics.read(made, numerics.frames))
        seconds = time.process_time() - begin
        out.append(Level({"contact": name}, mean_mm(found - numerics.positions), reading=seconds))
    return tuple(out)


def tolerances(recording: Recording, belief: Belief) -> tuple[Level, ...]:
    """Tolerances of the joint estimate, the tightest first."""
    out, places = [], []
    for rest in TOLERANCES:
        begin = time.process_time()
        places.append(calibrate(recording, belief, tolerance=rest).positions)
        seconds = time.process_time() - begin
        moved = mean_mm(places[-1] - places[0])
        out.append(Level({"tolerance": rest}, error_mm=moved, reading=seconds))
    return tuple(out)


def surfaces(numerics: Numerics, scene: Scene, accuracy_mm: float) -> tuple[Level, ...]:
    """Faces of a primitive's mesh, judged by the exact surface: finer ones only where it matters,
    and the highest degree with them.
    """
    own = Setting.of(scene)
    if own.faces is None:
        return (Level(),)
    out = [Level({"faces": own.faces, "degree": own.degree}, geometry(numerics).mean_mm)]
    if out[0].numerical_mm > FINE * accuracy_mm:
        for faces in (own.faces, FINER * own.faces):
            setting, begin = replace(own, faces=faces, degree=4), time.process_time()
            body = setting.body(scene.body)
            body.closest(scene.skin.positions)
            once = time.process_time() - begin
            made = numerics.scene.with_(body=body)
            there = geometry(Numerics(made, numerics.tolerance, numerics.compile))
            out.append(Level({"faces": faces, "degree": 4}, there.mean_mm, once=once))
    return tuple(out)
