"""The knobs of a scene: contact model, mesh resolution, time step; each a ladder of settings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ...contact import BATCHED
from ...estimation.joint.newton import NEWTON_TOLERANCE
from ...geometry.body import Body

if TYPE_CHECKING:
    from ...scene.scene import Scene

SECONDS = {
    "face": 21e-6, "step": 13e-6, "hertz": 1e-7, "elliptic": 1.5e-6, "layered": 2.0e-6,
    "reading": 3e-6,
}  # fmt: skip
"""Prices in seconds: of each face of the body, each step of the loop with its planning, each taxel
and frame of a contact model, and each reading in each iterate of the calibration. They weigh counts
that are the same on every machine: were seconds taken on the spot, two calls could decide
differently, and a study would depend on its workers. `python studies/budget.py --prices` measures
them anew."""
TOLERANCES = (1.0, 1e-2, NEWTON_TOLERANCE)
"""Newton decrements at which a calibration may rest, the loosest first; with everything on, at the
last."""
FACES = (1 / 16, 1 / 4, 1, 4)
"""Faces of a primitive, relative to the scene's."""
FINER, COARSER = 4, (2, 5)
"""Steps from frame to frame: so many times the scene's, and parts of them that are whole."""
FEWEST_FACES = 80
"""Faces below which a mesh is no stand-in for a primitive (an icosphere divided once)."""
LONGEST_STEP = 0.01
"""s, as Loop allows."""


@dataclass(frozen=True)
class Rung:
    """One setting of a knob."""

    label: str
    changes: Mapping[str, Any]
    """Parts of the scene that it replaces."""
    seconds: float
    """What it costs in the whole run."""


@dataclass(frozen=True)
class Knob:
    """A ladder of settings, the cheapest first, the finest last."""

    name: str
    rungs: tuple[Rung, ...]
    declared: int
    """The scene's own setting."""


def knobs(scene: Scene, steps: int, frames: float) -> tuple[Knob, ...]:
    """The knobs that a scene has; those with one setting are left out.

    steps of the loop and frames of the whole run.
    """
    found = (contact_models(scene, frames), mesh_resolution(scene), time_step(scene, steps))
    return tuple(knob for knob in found if len(knob.rungs) > 1)


def contact_models(scene: Scene, frames: float) -> Knob:
    """The contact models that hold for the whole skin."""
    names = [name for name in BATCHED if _holds(scene, name)]
    cells = frames * len(scene.skin.ids)
    rungs = tuple(Rung(name, {"contact": name}, SECONDS[name] * cells) for name in names)
    return Knob("contact model", rungs, names.index(scene.model.name))


def _holds(scene: Scene, name: str) -> bool:
    """Whether a contact model holds at every taxel at which the scene's own does; a layer that is
    not there is no reason for it.
    """
    if name == "layered" and scene.material.thickness is None:
        return name == scene.model.name
    curvature = scene.body.closest(scene.skin.positions).curvature
    own, other = (s.invalid_reasons(curvature) == "" for s in (scene, scene.with_(contact=name)))
    return bool(np.all(other | ~own))


def mesh_resolution(scene: Scene) -> Knob:
    """Faces that the smooth surface of a primitive is fitted to; a loaded mesh is as it is.

    The flat facets that a robot's software has are no matter of computing, and stay. Where faces
    are so few that a smooth body gets creases or flat places, they do not stand in for it.
    """
    body = scene.body
    own = Rung(_faces(body), {"body": body}, SECONDS["face"] * len(body.mesh.faces))
    if body.exact is None:
        return Knob("mesh", (own,), 0)
    rungs: dict[str, Rung] = {}
    for factor in FACES:
        count = round(factor * len(body.mesh.faces))
        if count < FEWEST_FACES:
            continue
        made = body if factor == 1 else body.remeshed(count)
        if body.surface.smooth and not made.surface.smooth:
            continue
        rungs[_faces(made)] = Rung(
            _faces(made), {"body": made}, SECONDS["face"] * len(made.mesh.faces)
        )
    return Knob("mesh", tuple(rungs.values()), list(rungs).index(own.label))


def _faces(body: Body) -> str:
    return f"{len(body.mesh.faces)} faces"


def time_step(scene: Scene, steps: int) -> Knob:
    """Steps of the loop that divide the time between frames."""
    own, rungs = scene.frame_steps, {}
    period = own * scene.loop.dt
    for count in (FINER * own, own, *(own // part for part in COARSER if own % part == 0)):
        dt = period / count
        if dt > LONGEST_STEP:
            continue
        changed = replace(scene.loop, dt=scene.loop.dt if count == own else dt)
        seconds = SECONDS["step"] * steps * count / own
        rungs[count] = Rung(f"{1e3 * dt:.4g} ms", {"loop": changed}, seconds)
    ordered = sorted(rungs)
    return Knob("time step", tuple(rungs[k] for k in ordered), ordered.index(own))


def finest_step(scene: Scene) -> Scene:
    """The scene at the finest of its time steps."""
    return scene.with_(loop=time_step(scene, 0).rungs[-1].changes["loop"])
