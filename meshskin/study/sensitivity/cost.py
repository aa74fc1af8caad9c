"""The cost of accuracy: error and seconds of every level of every knob of a scene.

Two errors are measured. The error is the mean distance of the calibrated taxels from the truth,
with the scene's own noise and effects; all settings use the same random numbers. The numerical part
is the mean shift of the taxels by discretization alone (numerical_error.py), from a reference at
the finest setting, which second routes confirm. A setting reaches an accuracy if the root of the
sum of both squares is within it and no taxel is lost. Seconds are processor time of loading,
simulating and calibrating on this machine.

The levels of all knobs then serve as a pilot (request.py) that predicts their combinations: for
each target, the cheapest one is measured, too.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from ...core.arguments import check_integer, check_real, check_type
from ...core.errors import StudyError, UnknownNameError
from ...core.notebook import Card, Tabular
from ...core.progress import Progress, Stage
from ...scene.scene import Scene
from .knobs import FINER, Level, single_changes, worthwhile
from .numerical_error import NumericalReference, Route, routes
from .request import Pilot, Request
from .setting import Setting
from .trial import Row, TrialRunner

if TYPE_CHECKING:
    import pyarrow as pa
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TARGETS = (1.0, 0.3, 0.1, 0.03, 0.01)
"""Accuracies of the table, mm: half a decade each."""
MARGINS = (1.0, 0.67)
"""Parts of a target that are requested, one after the other, until a combination holds: the
predictions of errors scatter by a few tens of per cent."""
LOOP, OTHERS = (
    ("dt", "integrator"),
    (("faces",), ("degree",), ("contact",), ("method", "tolerance")),
)
"""Knobs; those that are combined as one stand together, as not all pairs of their levels exist."""
RECORDED = (
    "error_mm", "numerical_mm", "bound_mm", "located", "contacts", "readings", "seconds", "failure",
)  # fmt: skip
"""Measurements of a row that tables hold."""
KNOBS = ("faces", "degree", "contact", "dt", "integrator", "lanes", "rate", "method", "tolerance")


@dataclass(frozen=True)
class Costs(Card, Tabular):
    """All measurements of one scene."""

    scene: str
    base: Setting
    """Setting of the scene."""
    reference: Setting
    """The finest setting, from which numerical parts are counted."""
    rows: tuple[Row, ...]
    """One per setting, in the order in which they were measured."""
    routes: tuple[Route, ...]
    """Second routes to the reference."""
    seeds: int
    """Number of runs of each setting."""

    @property
    def own(self) -> Row:
        """Row of the scene's own setting, the first."""
        return self.rows[0]

    @cached_property
    def whole(self) -> tuple[Row, ...]:
        """Rows without failure that located the largest number of taxels."""
        most = max((row.located for row in self.rows), default=0)
        return tuple(row for row in self.rows if not row.failure and row.located == most)

    @cached_property
    def front(self) -> tuple[Row, ...]:
        """The Pareto front: the rows than which no other is both quicker and more accurate."""
        return front(self.whole)

    def cheapest(self, target_mm: float) -> Row | None:
        """The quickest measured row within `target_mm`, mm; None if there is none."""
        within = [row for row in self.whole if row.total_mm <= target_mm]
        return min(within, key=lambda row: row.time, default=None)

    def facts(self) -> dict[str, str]:
        """The scene, its own error and time, and those of the front, for a notebook."""
        facts = {"scene": self.scene, "settings": f"{len(self.rows)}, {self.seeds} seeds each"}
        facts["its own"] = f"{self.own.total_mm:.3g} mm in {self.own.time:.3g} s"
        for row in self.front:
            words = f"{row.total_mm:.3g} mm: {row.setting.words(self.base)}"
            facts[f"front, {row.time:.3g} s"] = words
        return facts

    def plot(self, ax: Axes | None = None) -> Figure:
        """Draw the errors of the front over its seconds; ax: matplotlib axes (None: a figure)."""
        from ...core import drawing

        line = ([row.time for row in self.front], [[row.total_mm] for row in self.front])
        return drawing.curves(ax, [("", *line)], "processor seconds", "error (mm)")

    def to_arrow(self) -> pa.Table:
        """One row a setting: `records`."""
        import pyarrow as pa

        return pa.Table.from_pylist(self.records())

    def records(self) -> list[dict[str, Any]]:
        """The rows as plain values, for tables."""
        quick = set(map(id, self.front))
        return [
            {
                "knob": row.knob,
                "change": row.setting.words(self.base),
                **vars(row.setting),
                **{name: vars(row)[name] for name in RECORDED},
                "front": id(row) in quick,
            }
            for row in self.rows
        ]


def front(rows: Iterable[Row]) -> tuple[Row, ...]:
    """Rows that no other row beats in time and total error, the quickest first."""
    kept: list[Row] = []
    for row in sorted(rows, key=lambda r: (r.time, r.total_mm)):
        if not kept or row.total_mm < kept[-1].total_mm:
            kept.append(row)
    return tuple(kept)


def cost(
    scene: Scene,
    *,
    knobs: Collection[str] = KNOBS,
    seeds: int = 1,
    finer: int = FINER,
    targets: Iterable[float] = TARGETS,
    progress: Progress | None = None,
) -> Costs:
    """Measure every level of `knobs`, then the combinations predicted to reach the targets, mm.

    seeds: number of runs of each setting, with the same random numbers for all. finer: refinement
    of the mesh and the time step of the reference. progress(stage, done, total) is called after
    each setting. Raises UnknownNameError for an unknown knob, ConfigError without seeds, and the
    errors of the reference and of the scene itself; other settings that fail are rows that say why.
    """
    check_type(Scene, scene, "the scene of costs")
    for knob in knobs:
        if knob not in KNOBS:
            raise UnknownNameError("knob", knob, KNOBS)
    check_integer("seeds", seeds, least=1)
    check_integer("finer", finer, least=1)
    check_type(Iterable, targets, "targets, mm,")
    targets = tuple(check_real("a target", target, "mm", above=0.0) for target in targets)
    base = Setting.of(scene)
    finest = base.finest(scene, finer)

    asked = [
        (k, s) for k, s in single_changes(base, scene) if k == "scene" or (k in knobs and s != base)
    ]
    first = Stage(progress, "reference", 3)
    reference = NumericalReference(finest.scene(scene, finest.body(scene.body)), finest.tolerance)
    first.step()
    confirmed = routes(reference)
    first.step()
    # the first run of a process takes longer: no row includes it
    TrialRunner(scene, seeds, reference).run("scene", base)
    first.step()
    stage = Stage(progress, "cost", len(asked) + len(targets))
    runner = TrialRunner(scene, seeds, reference)
    rows: list[Row] = []
    for knob, setting in asked:
        rows.append(runner.measure(knob, setting))
        stage.step()
    measured = pilot_of(rows)
    for target in targets:
        _combine(runner, measured, rows, target)
        stage.step()
    stage.end()
    return Costs(scene.name, base, finest, tuple(rows), confirmed, seeds)


def pilot_of(rows: Sequence[Row]) -> Pilot:
    """The measurements of rows in which one knob was changed, the scene's own row first."""
    own = rows[0]
    good = [row for row in rows if not row.failure and row.located >= own.located]
    counted = [row for row in good if row.knob in ("scene", "lanes", "rate")]
    looped = [row for row in good if row in counted or row.knob in LOOP]
    names = list(dict.fromkeys(row.setting.integrator for row in looped))
    fixed, each_contact, *each_step = _prices(
        [row.seconds["simulate"] for row in looped],
        [(r.contacts, *(r.steps * (r.setting.integrator == n) for n in names)) for r in looped],
    )
    once, each_reading = _prices(
        [row.seconds["calibrate"] for row in counted], [(r.readings,) for r in counted]
    )
    steps = dict(zip(names, each_step, strict=True))
    loops = [
        Level(
            {k: getattr(r.setting, k) for k in LOOP},
            r.numerical_mm,
            along=steps[r.setting.integrator] * r.steps,
        )
        for r in good
        if r is own or r.knob in LOOP
    ]
    others = [[_level(r, own, g) for r in good if r is own or r.knob in g] for g in OTHERS]
    # the squared error by noise falls with the number of contacts; what remains is systematic
    systematic, by_noise = _prices(
        [row.error_mm**2 for row in counted], [(1.0 / row.contacts,) for row in counted]
    )
    return Pilot(
        base=own.setting,
        setting=own.setting,
        steps=own.steps,
        contacts=own.contacts,
        readings=own.readings,
        bound_mm=math.sqrt(by_noise / own.contacts),
        systematic_mm=math.sqrt(systematic),
        lane_spacings=tuple(dict.fromkeys(row.setting.lane_spacing for row in counted)),
        rates=tuple(dict.fromkeys(row.setting.rate for row in counted)),
        knobs=tuple(worthwhile(levels) for levels in (loops, *others)),
        fixed=own.seconds["load"] + fixed,
        each_step=steps[own.setting.integrator],
        each_contact=each_contact,
        estimating=(once, each_reading),
        spent=(0.0, 0.0),
    )


def _prices(totals: Sequence[float], counts: Sequence[tuple[float, ...]]) -> list[float]:
    """The fixed part of totals, and the part of each count, that fit best; none is negative."""
    from scipy.optimize import nnls

    terms = np.insert(np.array(counts, dtype=float), 0, 1.0, axis=1)
    scale = terms.max(axis=0)
    relative = terms / scale / np.array(totals)[:, None]
    return [float(x) for x in nnls(relative, np.ones(len(terms)))[0] / scale]


def _level(row: Row, own: Row, fields: tuple[str, ...]) -> Level:
    """The row as a level, with the errors that it adds to those of the scene's own row."""

    def added(part: str) -> float:
        return math.sqrt(max(getattr(row, part) ** 2 - getattr(own, part) ** 2, 0.0))

    return Level(
        {field: getattr(row.setting, field) for field in fields},
        added("numerical_mm"),
        added("error_mm") if row.knob == "method" else 0.0,
        once=row.seconds["load"],
        along=row.seconds["simulate"],
        reading=row.seconds["calibrate"],
    )


def _combine(runner: TrialRunner, measured: Pilot, rows: list[Row], target: float) -> None:
    """Measure the combination predicted to reach a target soonest; a second one if it does not."""
    for margin in MARGINS:
        try:
            setting = measured.choose(Request(accuracy_mm=margin * target))[0].setting
        except StudyError:
            return
        known = next((row for row in rows if row.setting == setting), None)
        row = known or runner.measure("chosen", setting)
        if known is None:
            rows.append(row)
        if not row.failure and row.total_mm <= target and row.located >= rows[0].located:
            return
