"""The layout of a skin from its readings alone, by which taxels answer together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_array, check_real, check_type, check_vector
from ...core.arrays import Array, Index, spread_rows
from ...core.errors import CalibrationError
from ...core.progress import Progress, Stage
from ...core.provenance import random_stream
from ...core.value import Value
from ...geometry.body import Body
from . import stress, tiles
from .alignment import aligned
from .coactivity import distinct_levels, largest_part, near_lengths, path_lengths, strokes
from .placement import ALIKE, Modules, best_on_body, fitted_modules, places_on, settled

SILENT = "answers in no frame"
APART = "answers together with no taxel of the largest part"
SELDOM = "answers together with others too seldom"
MAX_SCALE = 0.1
"""Largest spacing and touch radius, m: larger ones are given in millimetres."""
DRAWS = 16
"""Draws of the strokes' weights: standard deviations are known to 1 / sqrt(2 * 15) = 18 %."""
VARIATION = 0.3
"""Standard deviation of a stroke's weight about 1; displacements are divided by it. Small enough
that no place is left without touches, which a bootstrap's 1 does where lanes cross it once."""
PRESENT = 0.5
"""Share of the draws that must join a taxel to the others."""


@dataclass(frozen=True, eq=False)
class Layout(Value):
    """Positions of n taxels up to what readings alone do not tell, with their uncertainty."""

    ids: np.ndarray
    """(n,)"""
    positions: Array
    """(n, 2) in the plane, or (n, 3) on the body; NaN where a taxel is not placed."""
    sigma: Array
    """Standard deviation (n,) of the distance from the true position, the layouts aligned: what
    other touches would change, and what distances contradict each other."""
    reasons: np.ndarray
    """Why a taxel is not placed (n,) str; "" where it is."""
    unit: str
    """"m", or "spacings": distances of nearest neighbours, where nothing gave a scale."""
    gauge: str
    """What fixes the layout's place, and what of it is not determined."""
    factors: tuple[str, ...]
    """What the layout rests on."""
    misfit: float
    """Root mean square relative error of the distances in the layout."""

    @property
    def uncertain(self) -> np.ndarray:
        """Taxels (n,) bool whose sigma exceeds the distance of neighbours, or that are not placed.

        They may be out of order with their neighbours.
        """
        placed = self.reasons == ""
        limit = stress.neighbour_spacing(self.positions[placed])
        return np.asarray(~placed | ~(self.sigma <= limit))

    def __repr__(self) -> str:
        placed = int(np.sum(self.reasons == ""))
        return (
            f"<Layout: {placed} of {len(self.ids)} taxels placed, median sigma "
            f"{np.nanmedian(self.sigma):.3g} {self.unit}, {int(self.uncertain.sum())} uncertain>"
        )


@dataclass(frozen=True)
class _Known:
    """What is known of the taxels besides their readings."""

    spacing: float | None
    touch_radius: float | None
    module: np.ndarray | None
    """Module (n,) of each taxel."""
    offsets: Array | None
    """Their positions (n, 2) in the modules, m."""

    def plane(
        self, rows: Index, lengths: Array, start: Array | None = None
    ) -> tuple[Array, float, Modules | None]:
        """Positions (r, 2) of the taxels `rows`, the unit of their `lengths`, and their modules.

        start (r, 2): positions in that unit from which they are sought.
        """
        points = stress.in_plane(lengths, start)
        if self.module is not None and self.offsets is not None:
            module = np.unique(self.module[rows], return_inverse=True)[1]
            fitted, unit = fitted_modules(module, self.offsets[rows], points)
            modules, unit = settled(fitted, lengths, unit, free=True)
            return modules.positions, unit, modules
        unit = self.touch_radius or (self.spacing or 1.0) / stress.neighbour_spacing(points)
        return unit * points, unit, None


def layout(
    frames: ArrayLike,
    ids: ArrayLike | None = None,
    *,
    spacing: float | None = None,
    touch_radius: float | None = None,
    module_slots: ArrayLike | None = None,
    tiled: bool = False,
    body: Body | None = None,
    centre: ArrayLike | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> Layout:
    """Where the taxels of a skin are, from which of them answer together. No pose is needed.

    frames (m, n): readings of n taxels in m frames, binary or graded, 0 where a taxel is silent;
    each frame one touch, of any size. ids (n,): by default 0 to n - 1.
    The scale comes from one of: spacing, the median distance of a taxel from its three nearest, m;
    touch_radius, the distance from a touch's centre up to which taxels answer, m; module_slots
    (slots, 2 or 3), the positions of the taxels of a rigid module, m, with ids slots * module +
    slot, as `skin.slots.OFFSETS` of iCub. Without any, the unit is the spacing.
    tiled: triangular modules lie edge to edge in the plane.
    body: the taxels lie on its surface; it needs a scale, and excludes modules. centre (3,): where
    on it the middle of the skin is, m; by default the place whose curvature agrees best, which on
    most bodies is one of many.
    seed: of the draws for the standard deviations. progress(stage, done, total): called between the
    steps of the stage "layout".

    Raises CalibrationError for frames, ids or knowledge that cannot be used, ConfigError for a body
    or a seed of another type.
    """
    levels = distinct_levels(frames)
    numbers = _checked_ids(ids, levels.shape[1])
    known = _known(numbers, spacing, touch_radius, module_slots, tiled, body)
    middles = _middles(body, centre)
    rows, inner, reasons = _together(levels)
    stage = Stage(progress, "layout", DRAWS + 2)
    points, unit, modules = known.plane(rows, inner)
    stage.step()
    departure = _departures(stress.distances(points), inner, unit)
    scaled = bool(spacing or touch_radius) or modules is not None
    error, alike = stress.misfit(stress.distances(points), inner, unit), 0
    drawn = _drawn(levels, rows, known, points, unit, scaled, seed, stage)
    if tiled and modules is not None:
        modules, wrong = tiles.tiled(modules, near_lengths(levels[:, rows]).toarray(), unit)
        points, departure = modules.positions, np.hypot(departure, wrong[modules.module])
    if body is not None:
        placed, spread, alike = best_on_body(body, points, inner, unit, middles)
        points, error = placed.positions, stress.misfit(placed.along, inner, unit)
        departure = np.hypot(_departures(placed.along, inner, unit), spread)
    seldom = ~np.isfinite(drawn)
    reasons[rows[seldom]] = SELDOM
    keep = rows[~seldom]
    positions = spread_rows(points[~seldom], keep, len(numbers), np.nan)
    sigma = spread_rows(np.hypot(drawn, departure)[~seldom], keep, len(numbers), np.nan)
    stage.end()
    words = _gauge(known, scaled, len(middles), alike), _factors(known, tiled, body)
    return Layout(numbers, positions, sigma, reasons, "m" if scaled else "spacings", *words, error)


def _together(levels: np.ndarray) -> tuple[Index, Array, np.ndarray]:
    """Rows (r,) of the largest part of taxels that answer together, the lengths (r, r) of the paths
    between them, and for each taxel (n,) why it is not among them."""
    lengths, answers = path_lengths(levels), levels.any(axis=0)
    part = largest_part(lengths) & answers
    rows = np.flatnonzero(part)
    reasons = np.where(part, "", np.where(answers, APART, SILENT)).astype(object)
    return rows, lengths[np.ix_(rows, rows)], reasons


def _checked_ids(ids: ArrayLike | None, count: int) -> np.ndarray:
    given = np.arange(count) if ids is None else ids
    numbers = check_array("ids of a layout", given, error=CalibrationError)
    whole = numbers.shape == (count,) and np.array_equal(numbers, np.round(numbers))
    if not whole or len(np.unique(numbers)) < count:
        raise CalibrationError(
            "ids of a layout must be different whole numbers, one per column of the frames",
            value=f"shape {numbers.shape}",
            limit=f"({count},)",
        )
    return numbers.astype(np.int64)


def _known(
    ids: np.ndarray,
    spacing: float | None,
    touch_radius: float | None,
    module_slots: ArrayLike | None,
    tiled: bool,
    body: Body | None,
) -> _Known:
    """What the arguments of `layout` say. Raises CalibrationError."""
    given = [value for value in (spacing, touch_radius, module_slots) if value is not None]
    if len(given) > 1:
        raise CalibrationError(
            "a layout has one scale", remedy="give spacing, touch_radius or module_slots"
        )
    for what, value in (("spacing", spacing), ("touch_radius", touch_radius)):
        if value is not None:
            metres = "give it in metres: 0.005 for 5 mm"
            check_real(
                what, value, "m", above=0.0, most=MAX_SCALE, error=CalibrationError, remedy=metres
            )
    if tiled and module_slots is None:
        raise CalibrationError("tiled modules need module_slots")
    if body is not None and spacing is None and touch_radius is None:
        raise CalibrationError(
            "a layout on a body needs a scale, and no modules",
            remedy="give spacing or touch_radius, without module_slots",
        )
    if module_slots is None:
        return _Known(spacing, touch_radius, None, None)
    slots = check_array("module_slots", module_slots, error=CalibrationError)
    if slots.ndim != 2 or slots.shape[1] not in (2, 3) or len(slots) < 2:
        raise CalibrationError(
            "module_slots must be positions", value=f"shape {slots.shape}", limit="(slots, 2 or 3)"
        )
    if not np.isfinite(slots).all() or len(np.unique(slots[:, :2], axis=0)) < len(slots):
        raise CalibrationError("module_slots must be finite, and at different places in the plane")
    return _Known(None, None, ids // len(slots), slots[ids % len(slots), :2])


def _departures(along: Array, lengths: Array, unit: float) -> Array:
    """Root mean square error (n,) of each taxel's distances `along` (n, n) from all others."""
    return np.asarray(np.sqrt(np.mean((along - unit * lengths) ** 2, axis=1)))


def _drawn(
    levels: np.ndarray, rows: Index, known: _Known, points: Array, unit: float, scaled: bool,
    seed: int, stage: Stage,
) -> Array:  # fmt: skip
    """Root mean square displacement (r,), m, of the taxels `rows` at `points` (r, 2), m, in layouts
    from randomly weighted strokes; NaN for taxels that are apart in too many of them.

    Source: Rubin, "The Bayesian bootstrap", Annals of Statistics 9 (1981).
    """
    stroke = strokes(levels)
    random = random_stream(seed, "layout draws")
    square, count = np.zeros(len(rows)), np.zeros(len(rows))
    for _ in range(DRAWS):
        stage.step()
        weight = random.gamma(VARIATION**-2, VARIATION**2, stroke[-1] + 1)
        lengths = path_lengths(levels[:, rows], weight[stroke])
        part = largest_part(lengths)
        if part.sum() < 4:
            continue
        near, start = lengths[np.ix_(part, part)], points[part] / unit
        other, _, _ = known.plane(rows[part], near, start)
        off = aligned(other, points[part], scale=not scaled) - points[part]
        square[part] += np.sum(off**2, axis=1)
        count[part] += 1
    square /= VARIATION**2
    often = count >= PRESENT * DRAWS
    return np.where(often, np.sqrt(square / np.maximum(count, 1)), np.nan)


def _factors(known: _Known, tiled: bool, body: Body | None) -> tuple[str, ...]:
    """What the layout rests on, in words."""
    found = ["co-activation of the taxels, as of round touches spread evenly"]
    if known.module is not None:
        found.append("rigid modules of known slots: scale and handedness")
    if known.spacing:
        found.append(f"distance of neighbours {1e3 * known.spacing:.4g} mm")
    if known.touch_radius:
        found.append(f"taxels answer within {1e3 * known.touch_radius:.4g} mm of a touch")
    found += ["modules edge to edge"] * tiled + ["surface of the body"] * (body is not None)
    return tuple(found)


def _middles(body: Body | None, centre: ArrayLike | None) -> Array:
    """Places (p, 3), m, on the body where the middle of the layout may be; none without a body."""
    if body is None:
        if centre is not None:
            raise CalibrationError("centre of a layout needs a body", remedy="give body, too")
        return np.empty((0, 3))
    from ...geometry.body import Body

    check_type(Body, body, "body of a layout")
    if centre is None:
        return places_on(body)
    middle = check_vector("centre of a layout on a body", centre, error=CalibrationError)
    if not np.isfinite(middle).all():
        raise CalibrationError("centre of a layout on a body must be finite")
    return middle[None]


def _gauge(known: _Known, scaled: bool, places: int, alike: int) -> str:
    """Gauge of a layout in the plane, or of the best of `places` on a body, in words."""
    if not places:
        free = "position and angle in the plane"
        free += ", mirror image" * (known.module is None) + ", scale" * (not scaled)
        return f"middle at the origin; not determined: {free}"
    free = "mirror image, and motions that take the body to itself"
    if places == 1:
        return f"the middle is at the given centre; not determined: {free}"
    return (
        f"the best of {places} places on the body, {alike} of which start within "
        f"{100 * (ALIKE - 1):.0f} % of it; not determined: {free}"
    )
