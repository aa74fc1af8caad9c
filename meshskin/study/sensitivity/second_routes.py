"""Second routes to the reference of the numerical error: parts of it computed by other methods.

Each route gives the shift of the taxels if it replaces a part of the reference. A reference can be
trusted if these shifts are far below the errors that it measures.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ...contact import solve
from ...core.errors import ContactError
from ...simulation.readout import make_frames
from .numerical_error import NumericalReference

if TYPE_CHECKING:
    from ...core.arrays import Array
    from ...effects.frames import Frames

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
    frames = reference.drive(slow, rows)
    pressures = reference.readings.copy()
    pressures[: len(frames)] = reference.read(scene, _on(reference, frames))
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


def _on(reference: NumericalReference, frames: Frames) -> Frames:
    """Frames with the indenter and contact of the reference's scene."""
    return make_frames(
        reference.scene, frames.time, frames.points, frames.normals, frames.force, frames.centres,
        frames.q,
    )  # fmt: skip


def _route(name: str, reference: NumericalReference, pressures: Array) -> Route:
    shift = np.linalg.norm(reference.calibrate(pressures) - reference.positions, axis=1)
    moved = shift[shift > 1e-12]
    if not len(moved):
        return Route(name, 0.0, 0.0)
    return Route(name, 1e3 * float(moved.mean()), 1e3 * float(moved.max()))
