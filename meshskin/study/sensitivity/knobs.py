"""The knobs of a scene and their levels: mesh, contact model, time step, integrator, lanes, frame
rate, estimator, tolerance."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any

import numpy as np

from ...contact import BATCHED
from ...core.arrays import Array
from ...estimation.calibrate import METHODS
from ...estimation.joint.reduced_nlp import NEWTON_TOLERANCE
from ...geometry.body import Body
from ...scene.scene import Scene
from .setting import Setting

FINER = 4
"""Refinement of mesh and time step at which discretization errors are small against those of the
scene's own: both converge at least in first order."""
FACES = (1 / 16, 1 / 4, 1, FINER)
"""Numbers of faces of a primitive, relative to the scene's: one subdivision each."""
FEWEST_FACES = 80
"""Fewest faces of a mesh that represents a primitive: an icosphere divided once."""
COARSER = (2, 5)
"""Time steps relative to the scene's that save seconds: they divide the usual 10 steps a frame."""
LONGEST_STEP = 0.01
"""Longest time step, s, that the settings of the loop accept."""
INTEGRATORS = ("semi_implicit", "linearly_implicit", "rk4")
"""Integrators of a fixed step that an arm's loop has."""
LANES = (0.5, 0.7, 1.0, 1.4, 2.0)
"""Spacings of the lanes relative to the scene's, which change the contacts by 1.4 per level."""
RATES = (0.25, 0.5, 1.0, 2.0, 5.0, 10.0)
"""Frame rates relative to the scene's that divide the usual 10 steps a frame."""
TOLERANCES = (1.0, 1e-2, NEWTON_TOLERANCE)
"""Newton decrements at which the estimate may stop."""
SAVED = 0.8
"""A level with a larger error must take less than this part of the seconds of the scene's own
level, because timings scatter."""
SECONDS = {
    "face": 21e-6, "step": 13e-6, "hertz": 1e-7, "elliptic": 1.5e-6, "layered": 2.0e-6,
    "reading": 3e-6,
}  # fmt: skip
"""Seconds of each face of the body, each step of the loop with its planning, each taxel and frame
of a contact model, and each reading in each iteration of the calibration. A budget weighs counts by
them, which are equal on every machine: with measured seconds, two calls could decide differently.
`python studies/budget.py --prices` measures them."""


@dataclass(frozen=True)
class Level:
    """One level of a knob, its effect on the taxels and its processor seconds."""

    changes: Mapping[str, Any] = field(default_factory=dict)
    """Values that it changes, by field of Setting."""
    numerical_mm: float = 0.0
    """Mean shift of the taxels by the simulation."""
    error_mm: float = 0.0
    """Mean shift of the taxels by the estimate."""
    once: float = 0.0
    """Seconds that do not depend on the length of the run."""
    along: float = 0.0
    """Seconds in proportion to the length of the path."""
    reading: float = 0.0
    """Seconds in proportion to the number of readings."""
    label: str = ""
    """The level in words."""
    shift: Array = field(default_factory=lambda: np.zeros((0, 3)), compare=False)
    """Shift of the taxels (n, 3), m, against the finest level, if measured taxel by taxel."""

    @property
    def shift_mm(self) -> float:
        """Mean shift of the taxels by simulation and estimate."""
        return float(np.hypot(self.numerical_mm, self.error_mm))

    @property
    def seconds(self) -> float:
        """Seconds in all."""
        return self.once + self.along + self.reading


def worthwhile(levels: Sequence[Level]) -> tuple[Level, ...]:
    """The first level, and the others that have a smaller error or take notably fewer seconds."""
    own, *others = levels
    kept = [x for x in others if x.shift_mm < own.shift_mm or x.seconds < SAVED * own.seconds]
    return own, *kept


@dataclass(frozen=True)
class Knob:
    """A knob with its levels, the cheapest first, the finest last."""

    name: str
    levels: tuple[Level, ...]
    declared: int
    """Index of the scene's own level."""


def scene_knobs(
    scene: Scene, bodies: Mapping[int, Body], steps: int, frames: float
) -> tuple[Knob, ...]:
    """The knobs of a scene with more than one level, priced by SECONDS.

    bodies: as of `mesh_bodies`. steps of the loop and frames: of the whole run.
    """
    names = contact_models(scene)
    cells = frames * len(scene.skin.ids)
    models = [Level({"contact": n}, reading=SECONDS[n] * cells, label=n) for n in names]
    meshes = [Level({"faces": n}, once=SECONDS["face"] * n, label=f"{n} faces") for n in bodies]
    own, times = scene.loop.dt, time_steps(scene)
    loops = [
        Level({"dt": dt}, along=SECONDS["step"] * steps * own / dt, label=f"{1e3 * dt:.4g} ms")
        for dt in times
    ]
    knobs = (
        Knob("contact model", tuple(models), names.index(scene.model.name)),
        Knob("mesh", tuple(meshes), list(bodies).index(len(scene.body.mesh.faces))),
        Knob("time step", tuple(loops), times.index(own)),
    )
    return tuple(knob for knob in knobs if len(knob.levels) > 1)


def contact_models(scene: Scene) -> list[str]:
    """The contact models that hold at every taxel at which the scene's own model holds.

    The layered model needs a layer, unless it is the scene's own.
    """
    curvature = scene.body.closest(scene.skin.positions).curvature
    own = scene.invalid_reasons(curvature) == ""

    def holds(name: str) -> bool:
        if name == "layered" and scene.material.thickness is None:
            return name == scene.model.name
        return bool(np.all((scene.with_(contact=name).invalid_reasons(curvature) == "") | ~own))

    return [name for name in BATCHED if holds(name)]


def mesh_bodies(scene: Scene) -> dict[int, Body]:
    """Bodies by the number of faces to which their smooth surface is fitted, the coarsest first.

    A loaded mesh is not changed, and neither are the flat facets in a robot's software. A mesh so
    coarse that a smooth primitive gets creases or flat regions is left out.
    """
    body = scene.body
    count = len(body.mesh.faces)
    if body.exact is None:
        return {count: body}
    bodies = {}
    for factor in FACES:
        faces = round(factor * count)
        if factor != 1 and faces < FEWEST_FACES:
            continue
        made = body if factor == 1 else body.remeshed(faces)
        if not body.surface.smooth or made.surface.smooth:
            bodies[len(made.mesh.faces)] = made
    return bodies


def time_steps(scene: Scene) -> list[float]:
    """Time steps, s, that divide the time between frames, the longest first."""
    own = scene.frame_steps
    period = own * scene.loop.dt
    counts = {FINER * own, own, *(own // part for part in COARSER if own % part == 0)}
    steps = [scene.loop.dt if n == own else period / n for n in sorted(counts)]
    return [dt for dt in steps if dt <= LONGEST_STEP]


def single_changes(base: Setting, scene: Scene) -> Iterator[tuple[str, Setting]]:
    """The levels of every knob, one knob changed at a time, as (knob, setting)."""
    yield "scene", base
    if base.faces is not None:
        for factor in FACES:
            yield "faces", replace(base, faces=round(base.faces * factor))
    for degree in (2, 3, 4):
        yield "degree", replace(base, degree=degree)
    for contact in BATCHED:
        yield "contact", replace(base, contact=contact)
    for integrator, factor in product(integrators(scene), (0.5, 1.0, *COARSER)):
        knob = "dt" if integrator == base.integrator else "integrator"
        yield knob, replace(base, integrator=integrator, dt=base.dt * factor)
    for factor in LANES:
        yield "lanes", replace(base, lane_spacing=base.lane_spacing * factor)
    for factor in RATES:
        yield "rate", replace(base, rate=base.rate * factor)
    for method in METHODS:
        yield "method", replace(base, method=method)
    for tolerance in TOLERANCES:
        yield "tolerance", replace(base, tolerance=tolerance)


def integrators(scene: Scene) -> Sequence[str]:
    """The integrators that the scene's loop can use, its own first."""
    others = INTEGRATORS if scene.loop.mode == "arm" else ()
    return list(dict.fromkeys((scene.loop.integrator, *others)))
