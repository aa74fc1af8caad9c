"""What several studies press: bodies of links, scenes without an arm, contacts all over a skin."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

import meshskin as ms
from meshskin.core.errors import MeshError
from meshskin.geometry.mesh import mesh_file

LARGEST_IN_METRES = 5.0
"""Extent of a file above which its unit is mm."""


def mesh_files(places: list[Path]) -> list[Path]:
    """The mesh files among some paths, and below those that are folders."""
    files = {file for place in places for file in (place.rglob("*") if place.is_dir() else [place])}
    return sorted(file for file in files if file.suffix.lower()[1:] in mesh_file.FORMATS)


def load_link(file: Path) -> ms.Body:
    """The body of a mesh file, closed or open, in the unit that its format says, else in m or mm by
    its size."""
    units = None
    if file.suffix.lower()[1:] not in ("dae", *mesh_file.METRES):
        extent = np.ptp(mesh_file.read(file, 1.0).vertices, axis=0)
        units = "mm" if extent.max() > LARGEST_IN_METRES else "m"
    try:
        return ms.Body.load(file, units=units)
    except MeshError:
        return ms.Body.load(file, units=units, open=True)


def pressed(
    skin: ms.Skin, body: ms.Body, name: str, *, radius: float, young: float, force: float = 3.0,
    lane: float = 2.5e-3, contact: str = "auto",
) -> ms.Scene:  # fmt: skip
    """A skin with 1 % noise that is moved exactly, in lanes, over an indenter of a radius, m."""
    base = ms.Scene.load("sphere_noisy")
    return base.with_(
        name=name,
        body=body,
        skin=skin,
        contact=contact,
        material=ms.Material(young=young),
        indenter=ms.Indenter.sphere(radius),
        law=replace(base.law, force_reference=force),
        loop=replace(base.loop, mode="quasi_static"),
        exploration=replace(base.exploration, pattern="lanes", lane_spacing=lane),
    )


def spiral(skin: ms.Skin, count: int, beyond: float) -> np.ndarray:
    """Points (count, 3), m, evenly over a flat disc about a skin and `beyond`, m, its rim."""
    k, centre = np.arange(count) + 0.5, skin.positions.mean(axis=0)
    reach = np.linalg.norm(skin.positions - centre, axis=1).max() + beyond
    angle, radius = np.pi * (3 - np.sqrt(5)) * k, reach * np.sqrt(k / count)
    return centre + np.column_stack([radius * np.cos(angle), radius * np.sin(angle), 0 * k])
