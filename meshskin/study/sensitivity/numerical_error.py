"""The numerical error of a simulation: the shift of the taxels by its discretization alone.

The closed loop of a setting runs along the path of the reference, without noise. The pressures on
its skin are assigned to the contacts of the reference and calibrated. If both loops were equal, no
taxel would move, so errors of the surface, of the contact model and of the integration all appear
as one length: the shift of the taxels.

Second routes compute parts of the reference by other methods. It can be trusted if the shifts that
they cause are far below the errors that it measures.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ... import effects
from ...contact import solve
from ...core.arrays import Array
from ...core.errors import ContactError, SimulationError
from ...effects.frames import EffectClock, Frames
from ...estimation.calibrate import calibrate
from ...exploration.plan import plan_exploration
from ...scene.scene import Scene
from ...simulation.readout import contact_frames, effect_pipeline, make_frames, record
from ...simulation.simulate import prepare, run
from ...simulation.state_machine import SLIDE

SIGMA = 0.01
"""Standard deviation by which the readings of a scene without noise are weighted, relative to the
peak pressure: as in the shipped scene sphere_noisy."""


class NumericalReference:
    """A simulation at a fine setting, and the shift of others along its path.

    scene: at the fine setting; its step divides that of all others. tolerance: of the calibrations.
    compile_: of all loops, because they run many times.
    """

    def __init__(self, scene: Scene, tolerance: float, compile_: str = "always") -> None:
        self.tolerance, self.compile = tolerance, compile_
        self.scene = self.bare(scene)
        self.path = plan_exploration(self.scene).path
        self.frames = self.drive(self.scene)
        known = scene.belief().noise_sigma
        self.belief = scene.belief(noise_sigma=known or SIGMA * scene.patch.peak)
        self.readings = self.read(self.scene, self.frames)
        self.positions = self.calibrate(self.readings)

    def shift(self, scene: Scene) -> Array:
        """The shift (n, 3), m, of the taxels if `scene` replaces the reference.

        Raises SimulationError if the loop fails or loses contact, ContactError.
        """
        scene = self.bare(scene)
        return self.calibrate(self.read(scene, self.drive(scene))) - self.positions

    def bare(self, scene: Scene) -> Scene:
        """A scene without effects, its loop compiled as the reference's."""
        return scene.with_(effects=(), loop=replace(scene.loop, compile=self.compile))

    def drive(self, scene: Scene, rows: int | None = None) -> Frames:
        """The frames of a scene's loop along the reference's path, or its first `rows` rows.

        Raises SimulationError.
        """
        factor = scene.loop.dt / self.scene.loop.dt
        every = round(factor)
        if abs(factor - every) > 1e-6 or every < 1:
            raise SimulationError(
                "the step must be a multiple of the reference's", value=f"{scene.loop.dt} s"
            )
        whole = self.path if rows is None else self.path.segments[0].truncated(rows)
        path = whole.resampled(scene.loop.dt, scene.body)
        lengths = [len(segment.points) for segment in path.segments]
        machine, _ = prepare(scene, path=path)
        steps = [part for part in run(scene, machine, path) if part.phase == SLIDE]
        ends = np.cumsum([len(part.time) for part in steps])
        frames: list[Frames] = []
        for end in np.cumsum(lengths):
            count = int(np.searchsorted(ends, end)) + 1
            frames.append(contact_frames(scene, machine.loop, steps[:count]))
            steps, ends = steps[count:], ends[count:]
        wanted = sum(-(-length // scene.frame_steps) for length in lengths)
        if steps or sum(map(len, frames)) != wanted:
            raise SimulationError("the loop lost contact on the reference's path")
        return functools.reduce(lambda one, next_: one.append(next_), frames)

    def read(self, scene: Scene, frames: Frames) -> Array:
        """Pressures (m, n), Pa, without effects."""
        return effect_pipeline(scene, 0).read(frames, scene.skin.poses)

    def calibrate(self, pressures: Array) -> Array:
        """Positions (n, 3), m, from pressures (m, n), Pa, in the contacts of the reference."""
        chain = effects.EffectPipeline((), lambda frames, poses: pressures, (), (), EffectClock())
        recording = record(self.scene, self.frames, chain)
        return calibrate(recording, self.belief, tolerance=self.tolerance).positions


def mean_mm(shift: Array) -> float:
    """Mean length, mm, of shifts (n, 3), m, over the taxels that have one."""
    length = np.linalg.norm(shift, axis=1)
    return 1e3 * float(np.nanmean(length)) if np.isfinite(length).any() else float("nan")


WINDOW = 0.15
"""Seconds of the path for which CVODES is run: it takes a thousand times as long."""


@dataclass(frozen=True)
class Route:
    """A second route and its distance from the reference."""

    name: str
    """The part of the reference and the other method."""
    mean_mm: float
    """Mean shift of the taxels that it moves."""
    largest_mm: float
    """Largest shift of a taxel."""


def routes(reference: NumericalReference) -> tuple[Route, ...]:
    """All second routes that exist for the scene of the reference."""
    found = []
    if reference.scene.body.exact is not None:
        found.append(geometry(reference))
    if reference.scene.loop.mode == "arm":
        found.append(integration(reference))
    return (*found, contact(reference))


def geometry(reference: NumericalReference) -> Route:
    """The exact surface of a primitive instead of patches on a mesh."""
    scene, frames = reference.scene, reference.frames
    exact = scene.body.exact
    assert exact is not None
    hit = exact.closest(frames.centres)
    press = scene.model.force(
        depth=scene.indenter.radius - hit.distance,
        curvature=hit.curvature,
        indenter_radius=scene.indenter.radius,
        effective_modulus=scene.material.effective_modulus,
    )
    there = replace(
        frames,
        points=hit.point,
        normals=hit.normal,
        force=np.asarray(press),
        curvature=hit.curvature,
        directions=hit.direction,
    )
    return _route("surface: exact primitive", reference, reference.read(scene, there))


def integration(reference: NumericalReference) -> Route:
    """CVODES with tolerance 1e-10 instead of Runge-Kutta, along the start of the path."""
    scene = reference.scene
    frame_period = scene.frame_steps * scene.loop.dt
    slow = scene.with_(loop=replace(scene.loop, integrator="cvodes", dt=min(frame_period, 1e-3)))
    rows = round(WINDOW / scene.loop.dt)
    f = reference.drive(slow, rows)
    frames = make_frames(scene, f.time, f.points, f.normals, f.force, f.centres, f.q)
    pressures = reference.readings.copy()
    pressures[: len(frames)] = reference.read(scene, frames)
    return _route(f"integration: CVODES, the first {WINDOW:g} s", reference, pressures)


def contact(reference: NumericalReference) -> Route:
    """Boundary elements instead of the contact model, at the centre of the skin.

    The difference in pressure there is added to every contact.
    """
    scene = reference.scene
    centre = scene.body.closest(scene.skin.positions.mean(axis=0)[None])
    case: dict[str, Any] = {
        "force": scene.law.force_reference,
        "curvature": tuple(centre.curvature[0]),
        "indenter_radius": scene.indenter.radius,
        "modulus": scene.material.young,
        "poisson": scene.material.poisson,
        "thickness": scene.material.thickness,
    }
    disc = scene.skin.disc_radius
    try:
        field, model = solve("field", **case), solve(scene.model.name, **case)
    except ContactError as error:
        return Route(f"contact: none ({error})", float("nan"), float("nan"))
    frames, positions = reference.frames, scene.skin.positions
    row, col = np.nonzero(reference.readings > 0)
    offset = positions[col] - frames.points[row]
    first = np.einsum("ij,ij->i", offset, frames.directions[row])
    second = np.einsum("ij,ij->i", offset, np.cross(frames.normals, frames.directions)[row])
    xy = np.stack([second, first], axis=1)  # a patch's x axis lies along the smaller curvature
    pressures = reference.readings.copy()
    pressures[row, col] += field.reading(xy, disc) - model.reading(xy, disc)
    return _route("contact: boundary elements", reference, np.maximum(pressures, 0.0))


def _route(name: str, reference: NumericalReference, pressures: Array) -> Route:
    shift = np.linalg.norm(reference.calibrate(pressures) - reference.positions, axis=1)
    moved = shift[shift > 1e-12]
    if not len(moved):
        return Route(name, 0.0, 0.0)
    return Route(name, 1e3 * float(moved.mean()), 1e3 * float(moved.max()))
