"""Second routes to the reference: what it computes, computed otherwise.

Each route answers with the shift of the taxels that it causes in the reference's place. A reference
whose second routes agree far below the errors that it measures can be believed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ...contact import solve
from ...core.errors import ContactError
from ...simulation.readout import make_frames
from .numerical_error import Numerics

if TYPE_CHECKING:
    from ...core.se3 import Array
    from ...effects.frames import Frames

WINDOW = 0.15
"""Seconds of the path that CVODES runs along: it takes a thousand times as long."""


@dataclass(frozen=True)
class Route:
    """A second route and how far from the reference it ends."""

    name: str
    """What is computed, and how it is computed otherwise."""
    mean_mm: float
    """Mean shift of the taxels that it moves."""
    largest_mm: float


def routes(numerics: Numerics) -> tuple[Route, ...]:
    """All second routes that the reference's scene has."""
    found = []
    if numerics.scene.body.exact is not None:
        found.append(geometry(numerics))
    if numerics.scene.loop.mode == "arm":
        found.append(integration(numerics))
    return (*found, contact(numerics))


def geometry(numerics: Numerics) -> Route:
    """The exact surface in place of patches on a mesh: foot, normal, curvature, depth and force."""
    scene, frames = numerics.scene, numerics.frames
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
    return _route("surface: exact primitive", numerics, numerics.read(scene, there))


def integration(numerics: Numerics) -> Route:
    """CVODES at 1e-10 in place of Runge-Kutta, along the start of the path."""
    scene = numerics.scene
    coarse = numerics.frame_period
    slow = scene.with_(loop=replace(scene.loop, integrator="cvodes", dt=min(coarse, 1e-3)))
    rows = round(WINDOW / scene.loop.dt)
    frames = numerics.drive(slow, rows)
    pressures = numerics.readings.copy()
    pressures[: len(frames)] = numerics.read(scene, _on(numerics, frames))
    return _route(f"integration: CVODES, the first {WINDOW:g} s", numerics, pressures)


def contact(numerics: Numerics) -> Route:
    """A boundary-element contact in place of the model's patch, at the skin's centre.

    What it adds to the pressure over the patch there is added to every contact.
    """
    scene = numerics.scene
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
    frames, positions = numerics.frames, scene.skin.positions
    row, col = np.nonzero(numerics.readings > 0)
    offset = positions[col] - frames.points[row]
    first = np.einsum("ij,ij->i", offset, frames.directions[row])
    second = np.einsum("ij,ij->i", offset, np.cross(frames.normals, frames.directions)[row])
    xy = np.stack([second, first], axis=1)  # a patch's x axis lies along the smaller curvature
    pressures = numerics.readings.copy()
    pressures[row, col] += field.reading(xy, disc) - model.reading(xy, disc)
    return _route("contact: boundary elements", numerics, np.maximum(pressures, 0.0))


def _on(numerics: Numerics, frames: Frames) -> Frames:
    """Frames as the reference's scene sees them."""
    return make_frames(
        numerics.scene, frames.time, frames.points, frames.normals, frames.force, frames.centres,
        frames.q,
    )  # fmt: skip


def _route(name: str, numerics: Numerics, pressures: Array) -> Route:
    shift = np.linalg.norm(numerics.calibrate(pressures) - numerics.positions, axis=1)
    moved = shift[shift > 1e-12]
    if not len(moved):
        return Route(name, 0.0, 0.0)
    return Route(name, 1e3 * float(moved.mean()), 1e3 * float(moved.max()))
