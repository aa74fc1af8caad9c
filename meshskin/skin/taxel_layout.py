"""Layouts of taxels at a spacing, or in a number, on a region of a body's surface."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..core.arguments import check_real
from ..core.errors import SkinError
from ..core.progress import Progress, Stage
from ..core.provenance import random_stream
from ..geometry import region as regions
from ..geometry.body import Body
from ..geometry.geodesics import arc_length
from . import lattice
from .lattice import Lattice

MEAN_TOLERANCE = 0.01
"""Largest relative error of the mean distance between nearest neighbours."""
SCATTER_TOLERANCE = 0.03
"""Largest relative standard deviation of that distance without relaxing: a lattice that closes, as
on a small cap, has less than 0.01; grown over a whole sphere, torus or capsule 0.07 to 0.09."""
RELAXED_SPACING = 0.96
"""Mean distance between nearest neighbours of a relaxed lattice, relative to the perfect lattice of
as many sites on a plane of the same area: 0.944 to 0.955 on whole spheres, tori and capsules. It
is where the iteration for the spacing starts."""
MAX_GROWN = 1500
"""Largest number of sites that are grown one by one; a lattice of more is grown coarse and refined.
Growing queries the surface anew for each ring, refining once for all sites."""
USUAL_STEPS = 30
"""Usual number of rings and projections of a layout: 10 to 60."""
RETRIES = 3
"""Times that a lattice is laid out again with a corrected spacing. Two were needed at most on
spheres, ellipsoids, tori and capsules."""


def sites(
    body: Body,
    region: regions.Region,
    spacing: float | None,
    count: int | None,
    disc_radius: float,
    seed: int,
    progress: Progress | None,
) -> Lattice:
    """The lattice sites of `Skin.cover`, which see. Raises SkinError."""
    stage = Stage(progress, "cover", USUAL_STEPS)
    if spacing is None:
        assert count is not None
        found = _by_count(body, region, count, disc_radius, seed, stage)
    else:
        check_real("spacing of taxels", spacing, "m", error=SkinError)
        _check_spacing(body, spacing, disc_radius)
        found = _by_spacing(body, region, spacing, seed, count, stage)
    stage.end()
    if count is None:
        return found
    if len(found) < count:
        raise SkinError(
            "the taxels do not fit the region", value=f"{count} taxels", limit=f"{len(found)} fit",
            remedy="give a smaller spacing or a larger region",
        )  # fmt: skip
    return found.take(np.argsort(found.arc_length, kind="stable")[:count])


def _check_spacing(body: Body, spacing: float, disc_radius: float) -> None:
    """Raise SkinError for a spacing below the discs' diameter, or above the body's size."""
    if not (np.isfinite(spacing) and 2.0 * disc_radius <= spacing):
        raise SkinError(
            "the spacing of taxels is too small",
            value=f"{spacing * 1e3:g} mm",
            limit=f"at least {2e3 * disc_radius:g} mm, the discs' diameter",
            remedy="give a larger spacing or a smaller disc_radius",
        )
    if spacing > body.surface.scale:
        raise SkinError(
            "the spacing of taxels is larger than the body",
            value=f"{spacing * 1e3:g} mm",
            limit=f"{body.surface.scale * 1e3:g} mm",
            remedy="give it in m",
        )


def _by_spacing(
    body: Body, region: regions.Region, spacing: float, seed: int, count: int | None, stage: Stage
) -> Lattice:
    """Sites at a mean distance of `spacing` (m); with `count`, at least so many about the centre.

    Where the lattice cannot close evenly, its sites come closer than they should: it is laid out
    again with a larger spacing; of all lattices, that of the nearest mean distance is taken.
    """
    first = lattice.first_site(body, region, spacing, random_stream(seed, "skin layout"))
    best, least = first, np.inf
    refinements = 0 if count is not None else _refinements(regions.area(body, region), spacing)
    target = spacing / RELAXED_SPACING if refinements else spacing
    for _ in range(1 + RETRIES):
        if count is not None:
            margin = round(4.0 * np.sqrt(count))  # two rings, cut off by the caller
            found = lattice.grow(body, region, target, first, count + margin, None, stage)
            if len(found) < count:  # the centre may be on a small part of the region
                found = _about(body, region, target, first, count + margin, stage)
        else:
            found = lattice.fill(body, region, target, first, refinements, stage)
            found = replace(found, arc_length=np.zeros(len(found)))  # islands: other starts
        if found.spacing()[1] > SCATTER_TOLERANCE:
            found = lattice.relax(body, region, found, target, stage)
        mean, _ = found.spacing()
        error = 0.0 if len(found) < 3 else abs(mean / spacing - 1)
        if not error >= least:  # also of a lattice whose mean is not defined
            best, least = found, error
        if error < MEAN_TOLERANCE:
            break
        target *= spacing / mean
    return _from_centre(body, region, best, spacing)


def _about(
    body: Body, region: regions.Region, spacing: float, first: Lattice, count: int, stage: Stage
) -> Lattice:
    """At least `count` sites (spacing in m) about the first one, on several parts of the region;
    all that it holds where these are fewer."""
    radius = spacing * float(np.sqrt(lattice.ROW * count / np.pi))
    while True:
        near = regions.Around(region, first.at, radius)
        found = lattice.fill(body, near, spacing, first, 0, stage)
        if len(found) >= count or radius > 4.0 * body.surface.scale:
            return replace(found, arc_length=np.zeros(len(found)))
        radius *= np.sqrt(2.0)


def _by_count(
    body: Body, region: regions.Region, count: int, disc_radius: float, seed: int, stage: Stage
) -> Lattice:
    """At least `count` sites all over a region; exactly `count` if they had to be relaxed."""
    area = regions.area(body, region)
    spacing = float(np.sqrt(area / (lattice.ROW * count)))
    if count > MAX_GROWN:
        spacing *= 0.99 * RELAXED_SPACING  # 2 % too many, of which some are removed
    for _ in range(8):
        spacing = min(spacing, body.surface.scale)
        _check_spacing(body, spacing, disc_radius)
        first = lattice.first_site(body, region, spacing, random_stream(seed, "skin layout"))
        found = lattice.fill(body, region, spacing, first, _refinements(area, spacing), stage)
        if found.spacing()[1] > SCATTER_TOLERANCE:
            found = lattice.relax(body, region, found, spacing, stage)
            if len(found) > count > 2:
                found = lattice.decimate(body, region, found, count, stage)
        if len(found) >= count:
            break
        spacing *= 0.995 * float(np.sqrt(len(found) / count))
    return _from_centre(body, region, found, spacing)


def _refinements(area: float, spacing: float) -> int:
    """How often a lattice of MAX_GROWN sites on an area (m^2) is refined to a spacing (m)."""
    number = area / (lattice.ROW * spacing**2)
    return max(0, int(np.ceil(np.log(max(number, 1.0) / MAX_GROWN) / np.log(4.0))))


def _from_centre(body: Body, region: regions.Region, found: Lattice, spacing: float) -> Lattice:
    """The sites with arc lengths from the region's centre."""
    away = arc_length(region.centre(body), found.at)
    return replace(found, arc_length=np.maximum(away, found.arc_length - spacing))
