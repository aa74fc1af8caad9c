"""The cost of accuracy: error and seconds of every level of every knob of a scene.

Two errors are measured. The error is the mean distance of the calibrated taxels from the truth,
with the scene's own noise and effects; all settings use the same random numbers. The numerical part
is the mean shift of the taxels by discretisation alone (numerical_error.py), from a reference at
the finest setting, which second routes confirm (second_routes.py). A setting reaches an accuracy if
the root of the sum of both squares is within it and no taxel is lost. Seconds are processor time of
loading, simulating and calibrating on this machine.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

from ...core.arguments import check_integer, check_real, check_type
from ...core.errors import UnknownNameError
from ...scene.scene import Scene
from .cost_models import CostModel
from .knobs import FINER, single_changes
from .numerical_error import NumericalReference
from .second_routes import Route, routes
from .setting import Setting
from .trial import Row, TrialRunner

__all__ = ["KNOBS", "TARGETS", "Costs", "Route", "Row", "Setting", "cost", "front"]

TARGETS = (1.0, 0.3, 0.1, 0.03, 0.01)
"""Accuracies of the table, mm: half a decade each."""
MARGINS = (0.9, 0.6)
"""Parts of a target at which a combination is aimed, one after the other, until it holds: the
predictions of errors scatter by a few tens of per cent."""
KNOBS = ("faces", "degree", "contact", "dt", "integrator", "lanes", "rate", "method", "tolerance")

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Costs:
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

    def stored(self) -> dict[str, Any]:
        """All measurements as plain values, for JSON."""
        return asdict(self)

    @classmethod
    def restored(cls, stored: dict[str, Any]) -> Costs:
        """The Costs of which `stored` has made these values."""
        rows = (Row(**row | {"setting": Setting(**row["setting"])}) for row in stored["rows"])
        return cls(
            scene=stored["scene"],
            base=Setting(**stored["base"]),
            reference=Setting(**stored["reference"]),
            rows=tuple(rows),
            routes=tuple(Route(**route) for route in stored["routes"]),
            seeds=stored["seeds"],
        )

    def records(self) -> list[dict[str, Any]]:
        """The rows as plain values, for tables."""
        quick = set(map(id, self.front))
        return [
            {
                "knob": row.knob,
                "change": row.setting.words(self.base),
                **{name: getattr(row.setting, name) for name in Setting.__dataclass_fields__},
                "error_mm": row.error_mm,
                "numerical_mm": row.numerical_mm,
                "bound_mm": row.bound_mm,
                "located": row.located,
                "contacts": row.contacts,
                "readings": row.readings,
                "seconds": row.seconds,
                "front": id(row) in quick,
                "failure": row.failure,
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

    def reference(runner: TrialRunner) -> NumericalReference:
        return NumericalReference(runner.scene(finest), finest.tolerance)

    runner = TrialRunner(scene, seeds, reference)
    asked = [
        (k, s) for k, s in single_changes(base, scene) if k == "scene" or (k in knobs and s != base)
    ]
    total = len(asked) + len(targets)
    if progress is not None:
        progress("cost", 0, total)
    confirmed = routes(runner.reference)
    runner.run("scene", base)  # the first run of a process takes longer: no row includes it
    runner.forget()
    rows: list[Row] = []
    for done, (knob, setting) in enumerate(asked):
        rows.append(runner.measure(knob, setting))
        if progress is not None:
            progress("cost", done + 1, total)
    models = CostModel.fit(rows)
    for done, target in enumerate(targets):
        _combine(runner, models, rows, target)
        if progress is not None:
            progress("cost", len(asked) + done + 1, total)
    return Costs(scene.name, base, finest, tuple(rows), confirmed, seeds)


def _combine(runner: TrialRunner, models: CostModel, rows: list[Row], target: float) -> None:
    """Measure the combination predicted to reach a target soonest; a second one if it does not."""
    for margin in MARGINS:
        setting = models.cheapest(margin * target)
        if setting is None:
            return
        known = next((row for row in rows if row.setting == setting), None)
        row = known or runner.measure("chosen", setting)
        if known is None:
            rows.append(row)
        if not row.failure and row.total_mm <= target and row.located >= models.base.located:
            return
