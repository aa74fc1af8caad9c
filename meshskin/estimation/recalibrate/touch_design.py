"""The touches that test a map best: those that tell every unit from itself turned, dead or moved.

A change whose expected readings are d standard deviations from those of no change is confused with
it with a probability of at most exp(-d^2 / 8) / 2 (Bhattacharyya). Touches are chosen greedily to
reduce the sum of these bounds over all units and changes.

Source: Kailath, "The Divergence and Bhattacharyya Distance Measures in Signal Selection", IEEE
Transactions on Communication Technology 15 (1967).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pyarrow as pa

from ...contact import AUTO, LEARNED
from ...core.arguments import check_integer
from ...core.arrays import Array
from ...core.errors import CalibrationError
from ...core.notebook import AXES, Tabular
from ...core.progress import Progress, Stage
from ...core.value import Value
from ...scene.belief import Belief
from ...skin.skin import Skin
from .. import chart
from ..calibration import Calibration
from ..data.measurements import Measurements
from ..data.patch_shape import over_edges
from ..data.raw_readings import in_recorded_unit
from ..data.resolve_belief import contact_model, with_valid_model
from ..next_contact import candidates_around, reference_patches
from . import errors as error_model
from .hypotheses import dead, moved, ring, turned, unchanged
from .readings import touches_of
from .skin_map import SkinMap, skin_map
from .touches import Touches

MIN_SQUARE = 0.2
"""Squared difference of expected readings, in variances, below which a touch tells nothing."""
RINGS = (0.5, 0.85, 1.15)
"""Radii of the candidates about a taxel, in contact radii, beside its centre: readings inform most
where the profile is steep, near the edge of the patch."""


@dataclass(frozen=True, eq=False)
class TouchDesign(Value, Tabular):
    """k touches that test a map, the most useful first."""

    points: Array
    """(k, 3) on the body's surface, body frame, m."""
    normals: Array
    """Outward normals (k, 3)."""
    unit: np.ndarray
    """Number (k,) of the module, or id of the taxel, that each tests most."""
    units: np.ndarray
    """Numbers (u,) of all units."""
    confusion: Array
    """(u,) bound on the probability that the change of each unit that is tested least is confused
    with none: 0.5 where nothing tests it."""

    def __repr__(self) -> str:
        weak = f"at most {self.confusion.max():.2g}" if len(self.confusion) else "none"
        return (
            f"<TouchDesign: {len(self.points)} touches that test {len(self.units)} units, "
            f"confusion {weak}>"
        )

    def to_arrow(self) -> pa.Table:
        """One row a touch: x, y, z (m), nx, ny, nz, tests (number of the module, or id)."""
        numbers = dict(zip(AXES, [*self.points.T, *self.normals.T], strict=True))
        return pa.table(numbers | {"tests": self.unit})


def next_touches(
    previous: Calibration | Skin,
    belief: Belief | None = None,
    k: int = 20,
    units: np.ndarray | None = None,
    progress: Progress | None = None,
) -> TouchDesign:
    """The k touches under the reference force that test an earlier map best, for `recalibrate`.

    belief: as in `recalibrate`. units: numbers of the modules, or ids of the taxels, to test; by
    default all. progress("next touches", done, total): called after each of these. Raises
    CalibrationError without a belief or its reference force, for k < 1 and for no units.
    """
    k = check_integer("number of touches", k, least=1, error=CalibrationError)
    own = getattr(previous, "belief", None)  # a skin has none
    if belief is None and own is not None:
        belief = in_recorded_unit(own, getattr(previous, "response", None))
    if belief is None or belief.force_reference is None:
        raise CalibrationError(
            "touches are planned for a scene and a reference force",
            remedy="give a belief with force_reference",
        )
    known = skin_map(previous, belief)
    tested = np.arange(len(known.units)) if units is None else np.flatnonzero(
        np.isin(known.numbers, units)
    )  # fmt: skip
    if not len(tested):
        raise CalibrationError(
            f"the earlier map has no such {known.noun} to test", value=units,
            limit=f"{known.noun}s {known.numbers.min()} to {known.numbers.max()}",
            remedy="give numbers of modules, or ids of single taxels; without units all are tested",
        )  # fmt: skip
    touches = touches_of(_candidates(known, belief, tested), known)
    stage = Stage(progress, "next touches", len(tested))
    touch, pair, factor, owner = _factors(touches, known, tested, stage)
    if not len(touch):
        raise CalibrationError(
            "no touch tells a changed map from the earlier one",
            value=f"{belief.force_reference:g} N",
            remedy="give a belief with a larger force_reference, or with the true noise",
        )
    bound, chosen, served = np.full(len(owner), 0.5), [], []
    for _ in range(k):
        part = bound[pair] * (1 - factor)
        best = int(np.argmax(np.bincount(touch, part, len(touches.data.points))))
        mine = np.flatnonzero(touch == best)
        served.append(owner[pair[mine[np.argmax(part[mine])]]])
        bound[pair[mine]] *= factor[mine]
        chosen.append(best)
    worst = np.zeros(len(known.units))
    np.maximum.at(worst, owner, bound)
    return TouchDesign(
        points=touches.data.points[chosen],
        normals=touches.data.normals[chosen],
        unit=known.numbers[served],
        units=known.numbers[tested],
        confusion=worst[tested],
    )


def _candidates(known: SkinMap, belief: Belief, tested: np.ndarray) -> Measurements:
    """Touches at the reference force about the taxels of the units `tested`, without readings."""
    rows = np.concatenate([known.units[u] for u in tested])
    rows = rows[known.known[rows]]
    if not len(rows):
        raise CalibrationError("the earlier map has no place for the units to be tested")
    if belief.contact in (AUTO, LEARNED):
        curvature = belief.body.closest(known.points[rows]).curvature
        belief = with_valid_model(belief, np.full(len(rows), belief.force_reference), curvature)
    modulus = belief.material.effective_modulus
    radius = float(reference_patches(belief, np.zeros((1, 2)), modulus).first[0])
    charts = chart.charts_at(belief.body, known.points[rows])
    hit = belief.body.closest(candidates_around(charts, radius, RINGS))
    none, force = np.zeros(0, dtype=int), np.full(len(hit.point), belief.force_reference)
    return Measurements(
        belief=replace(belief, taxel_ids=known.ids),
        points=hit.point, normals=hit.normal, directions=hit.direction,
        curvature=hit.curvature, force=force, unevenness=over_edges(belief, hit, force),
        patches=reference_patches(belief, hit.curvature, modulus), model=contact_model(belief),
        contact=none, taxel=none, pressure=np.zeros(0), noise=belief.noise_sigma,
        threshold=belief.threshold, ends=np.full(len(known.ids), np.inf),
        time=np.zeros(len(force)),  # before any drift
    )  # fmt: skip


def _factors(
    touches: Touches, known: SkinMap, tested: np.ndarray, stage: Stage
) -> tuple[np.ndarray, np.ndarray, Array, np.ndarray]:
    """Touches (g,) and changes (g,) that they tell from none, the factors (g,) by which they reduce
    the bound on their confusion, and the unit of each change."""
    errors = replace(error_model.start(touches), common=((0.0, 0.0), (0.0, 0.0)))
    parts: list[tuple[np.ndarray, np.ndarray, Array]] = []
    owner: list[int] = []
    m = len(touches.data.points)
    for unit in tested:
        state = unchanged(known, int(unit))
        turns, moves = turned(known, int(unit), state), ring()[::2]
        changes = [state, dead(state), *turns, *moved(state, touches.data.body, moves)]
        blocks = touches.blocks(int(unit), changes, errors)
        size = len(state.points)
        mean = np.full((len(blocks), m * size), touches.threshold)
        variance = np.full(mean.shape, errors.sigma**2)
        for k, block in enumerate(blocks):
            cell = block.contact * size + block.taxel
            mean[k, cell] = np.maximum(block.mean, touches.threshold)
            places = state.covariance[block.taxel] + errors.tau**2 * np.eye(3)
            variance[k, cell] += (errors.rho * block.mean) ** 2 + block.bend
            variance[k, cell] += np.einsum("qi,qij,qj->q", block.slope, places, block.slope)
        square = (mean[1:] - mean[0]) ** 2 / np.maximum(variance[1:], variance[0])
        square = square.reshape(len(changes) - 1, m, size).sum(axis=2)
        change, touch = np.nonzero(square > MIN_SQUARE)
        parts.append((touch, change + len(owner), np.exp(-square[change, touch] / 8)))
        owner += [int(unit)] * (len(changes) - 1)
        stage.step()
    touch, pair, factor = (np.concatenate(x) for x in zip(*parts, strict=True))
    return touch, pair, factor, np.array(owner)
