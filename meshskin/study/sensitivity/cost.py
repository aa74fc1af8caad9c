"""What accuracy costs in time: every knob of a scene turned, each setting's error and seconds.

Two errors, kept apart. The error is the mean distance of the calibrated taxels from the truth,
under the scene's own noise and effects, seed by seed with the same random numbers. The numerical
part is how far the taxels are moved by discretisation alone (numerics.py), from a reference at the
finest setting that second routes confirm (reference.py). A setting reaches an accuracy when both
together, as root of the sum of squares, are within it and no taxel is lost. Seconds are processor
time of loading, simulating and calibrating on the machine at hand.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

from ...core.arguments import check_integer, check_real, check_type
from ...core.errors import UnknownNameError
from ...scene.scene import Scene
from .cost_models import Models
from .numerical_error import Numerics
from .second_routes import Route, routes
from .setting import Setting, ladders, reference
from .trial import Bench, Row

__all__ = ["KNOBS", "TARGETS", "Costs", "Route", "Row", "Setting", "cost", "front"]

TARGETS = (1.0, 0.3, 0.1, 0.03, 0.01)
"""Accuracies of the table, mm."""
MARGINS = (0.9, 0.6)
"""Parts of a target that a combination is chosen for, one after the other, until it holds."""
KNOBS = ("faces", "degree", "contact", "dt", "integrator", "lanes", "rate", "method", "tolerance")

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Costs:
    """Everything that was measured of one scene."""

    scene: str
    base: Setting
    """The scene's own setting."""
    reference: Setting
    """The finest, from which numerical parts are counted."""
    rows: tuple[Row, ...]
    """One a setting, in the order in which they were measured."""
    routes: tuple[Route, ...]
    """Second routes to the reference."""
    seeds: int

    @cached_property
    def whole(self) -> tuple[Row, ...]:
        """Rows without failure that located as many taxels as any."""
        most = max((row.located for row in self.rows), default=0)
        return tuple(row for row in self.rows if not row.failure and row.located == most)

    @cached_property
    def front(self) -> tuple[Row, ...]:
        """The Pareto front: no row is both quicker and more accurate."""
        return front(self.whole)

    def cheapest(self, target_mm: float) -> Row | None:
        """The quickest measured row within `target_mm`; None: none is."""
        within = [row for row in self.whole if row.total_mm <= target_mm]
        return min(within, key=lambda row: row.time, default=None)

    def stored(self) -> dict[str, Any]:
        """All of it as plain values; `restored` makes it from them again."""
        return asdict(self)

    @classmethod
    def restored(cls, stored: dict[str, Any]) -> Costs:
        """What `stored` was made from."""
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
        """The rows as plain values, for JSON and tables."""
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
    """Rows that no other row beats in both time and total error, the quickest first."""
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
    finer: int = 4,
    targets: Iterable[float] = TARGETS,
    progress: Progress | None = None,
) -> Costs:
    """Turn every knob of `knobs` by itself, then the combinations that promise the targets, mm.

    seeds: runs a setting, the same random numbers for all. finer: how much finer the reference's
    mesh and step are. progress(stage, done, total) is called as it goes. Raises UnknownNameError
    for an unknown knob, ConfigError without seeds, and what the reference and the scene itself
    raise; other settings that fail are rows that say why.
    """
    check_type(Scene, scene, "what is measured")
    for knob in knobs:
        if knob not in KNOBS:
            raise UnknownNameError("knob", knob, KNOBS)
    check_integer("seeds", seeds, least=1)
    check_integer("finer", finer, least=1)
    check_type(Iterable, targets, "targets, mm,")
    targets = tuple(check_real("a target", target, "mm", above=0.0) for target in targets)
    base = Setting.of(scene)
    finest = reference(base, scene, finer)

    def numerics(bench: Bench) -> Numerics:
        return Numerics(bench.scene(finest), finest.tolerance)

    bench = Bench(scene, seeds, numerics)
    asked = [(k, s) for k, s in ladders(base, scene) if k == "scene" or (k in knobs and s != base)]
    total = len(asked) + len(targets)
    if progress is not None:
        progress("cost", 0, total)
    confirmed = routes(bench.numerics)
    bench.run("scene", base)  # what the first run pays once, no row should pay
    bench.forget()
    rows: list[Row] = []
    for done, (knob, setting) in enumerate(asked):
        rows.append(bench.measure(knob, setting))
        if progress is not None:
            progress("cost", done + 1, total)
    models = Models.fit(rows)
    for done, target in enumerate(targets):
        _combine(bench, models, rows, target)
        if progress is not None:
            progress("cost", len(asked) + done + 1, total)
    return Costs(scene.name, base, finest, tuple(rows), confirmed, seeds)


def _combine(bench: Bench, models: Models, rows: list[Row], target: float) -> None:
    """Measure the combination that should reach a target soonest, a second one if it does not."""
    for margin in MARGINS:
        setting = models.cheapest(margin * target)
        if setting is None:
            return
        known = next((row for row in rows if row.setting == setting), None)
        row = known or bench.measure("chosen", setting)
        if known is None:
            rows.append(row)
        if not row.failure and row.total_mm <= target and row.located >= models.base.located:
            return
