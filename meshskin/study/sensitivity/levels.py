"""Levels of the knobs that a request may change, measured along the path of a pilot run.

Each function gives the levels of one knob, the scene's own first, with the shift of the taxels (as
`cost` measures it) and the seconds. The estimator is not such a knob: a run uses all of them in any
case, and the joint estimate has the smallest error.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from typing import TYPE_CHECKING

from ...core.arrays import Array
from ...core.errors import ConfigError, ContactError, ReachError, SimulationError
from ...estimation.calibrate import calibrate
from .knobs import FINER, TOLERANCES, Level, contact_models, integrators
from .numerical_error import NumericalReference, mean_mm
from .second_routes import geometry
from .setting import Setting
from .trial import timed

if TYPE_CHECKING:
    from ...geometry.body import Body
    from ...recording.recording import Recording
    from ...scene.belief import Belief
    from ...scene.scene import Scene

SAVED = 0.8
"""A level with a larger error must take less than this part of the seconds of the scene's own
level, because timings scatter."""
FINE = 0.1
"""Finer faces are tried if the scene's own surface takes more than this part of the accuracy asked
for. Coarser ones would save nothing, because they would have to be fitted besides."""


def worthwhile(levels: Sequence[Level]) -> tuple[Level, ...]:
    """The first level, and the others that have a smaller error or take notably fewer seconds."""
    own, *others = levels
    kept = [x for x in others if x.shift_mm < own.shift_mm or x.seconds < SAVED * own.seconds]
    return own, *kept


def loop_levels(
    reference: NumericalReference, scene: Scene, factors: Iterable[float]
) -> tuple[Level, ...]:
    """Time steps, as factors on the scene's own, with each integrator.

    Those with which the loop cannot be run are left out.
    """
    own, out = scene.loop, []
    for factor, integrator in product(factors, integrators(scene)):
        try:
            loop = replace(own, dt=own.dt * factor, integrator=integrator)
            made = reference.bare(scene.with_(loop=loop))
            frames, seconds = timed(partial(reference.drive, made))
        except (ConfigError, ContactError, ReachError, SimulationError):
            continue
        moved = reference.calibrate(reference.read(made, frames)) - reference.positions
        changes = {"dt": loop.dt, "integrator": integrator}
        out.append(Level(changes, mean_mm(moved), along=seconds))
    return tuple(out)


def contact_levels(reference: NumericalReference, scene: Scene) -> tuple[Level, ...]:
    """The contact models that hold where the scene's own model holds."""
    out = []
    for name in sorted(contact_models(scene), key=lambda name: name != scene.model.name):
        made = reference.scene.with_(contact=name)

        def positions(made: Scene = made) -> Array:
            return reference.calibrate(reference.read(made, reference.frames))

        found, seconds = timed(positions)
        moved = mean_mm(found - reference.positions)
        out.append(Level({"contact": name}, moved, reading=seconds))
    return tuple(out)


def tolerance_levels(recording: Recording, belief: Belief) -> tuple[Level, ...]:
    """Tolerances of the joint estimate."""
    out, tightest = [], None
    for tolerance in reversed(TOLERANCES):
        found, seconds = timed(partial(calibrate, recording, belief, tolerance=tolerance))
        tightest = found.positions if tightest is None else tightest
        moved = mean_mm(found.positions - tightest)
        out.append(Level({"tolerance": tolerance}, error_mm=moved, reading=seconds))
    return tuple(out)


def surface_levels(
    reference: NumericalReference, scene: Scene, accuracy_mm: float
) -> tuple[Level, ...]:
    """Faces of a primitive's mesh, compared with its exact surface.

    Finer ones, with the highest degree of the surface, are tried only if the scene's own take more
    than FINE of the accuracy.
    """
    own = Setting.of(scene)
    if own.faces is None:
        return (Level(),)
    error = geometry(reference).mean_mm
    out = [Level({"faces": own.faces, "degree": own.degree}, error)]
    if error > FINE * accuracy_mm:
        for faces in (own.faces, FINER * own.faces):

            def fit(faces: int = faces) -> Body:
                body = replace(own, faces=faces, degree=4).body(scene.body)
                body.closest(scene.skin.positions)
                return body

            body, once = timed(fit)
            made = reference.scene.with_(body=body)
            there = geometry(NumericalReference(made, reference.tolerance, reference.compile))
            out.append(Level({"faces": faces, "degree": 4}, there.mean_mm, once=once))
    return tuple(out)
