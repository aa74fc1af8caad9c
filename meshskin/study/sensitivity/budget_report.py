"""The ledger: what a budget decided, what it rests on, and how the check came out."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ...scene.belief import Belief
    from ...scene.scene import Scene

HEADER = ("effect", "", "mm", "seconds", "why")


@dataclass(frozen=True)
class Entry:
    """One effect or knob."""

    name: str
    setting: str
    """"on" or "off"; of a knob its setting."""
    on: bool
    """Whether the chosen scene has it; a knob is on where it is not at its coarsest setting."""
    shift: float
    """How far the taxels move for leaving it out, m: mean over taxels and seeds. Of what was not
    tried its bound; of a knob: of its setting against its finest."""
    seconds: float
    """What it costs in the whole run."""
    why: str

    def row(self) -> tuple[str, str, str, str, str]:
        """In words: name, setting, mm, seconds, why."""
        return (
            self.name.replace("_", " "), self.setting, f"{1e3 * self.shift:.4f}",
            f"{round(self.seconds, 3) + 0.0:.3f}", self.why,
        )  # fmt: skip


@dataclass(frozen=True)
class Check:
    """Everything on against the scene that was chosen, over contacts and seeds kept aside."""

    shift: float
    """How far the calibrated taxels move, m, mean: the true error of what was left out."""
    taxels: int
    """How many taxels were compared."""
    lost: int
    """How many were found with everything on only."""
    seconds: tuple[float, float]
    """Processor seconds of simulation and calibration, everything on, and as chosen."""

    @property
    def faster(self) -> float:
        """How many times faster the chosen scene ran."""
        return self.seconds[0] / max(self.seconds[1], 1e-9)


@dataclass(frozen=True)
class BudgetReport:
    """What `budget` decided."""

    budget: float
    """The taxel error, m, that may be left out."""
    entries: tuple[Entry, ...]
    """Effects and knobs, those that matter most first."""
    estimate: float
    """How far all that is off moves the taxels together, m, by the linearised calibration."""
    check: Check
    """How that compares with the truth."""
    scene: Scene = field(repr=False)
    """The chosen scene."""
    everything: Scene = field(repr=False)
    """The scene with everything on, at the finest settings."""
    belief: Belief = field(repr=False)
    """What the owner knows, whatever is on."""
    tolerance: float
    """Newton decrement at which the calibration may rest (`calibrate`'s tolerance)."""

    @property
    def fits(self) -> bool:
        """Whether the true error of what was left out is within the budget, and no taxel lost."""
        return self.check.shift <= self.budget and not self.check.lost

    @property
    def seconds(self) -> float:
        """What is on costs in the whole run, by the entries."""
        return sum(entry.seconds for entry in self.entries if entry.on)

    def summary(self) -> tuple[str, ...]:
        """Estimate, truth and speed in sentences."""
        check, mm = self.check, 1e3
        ratio = self.estimate / check.shift if check.shift > 0 else float("inf")
        lost = f" {check.lost} taxels were found with everything on only." if check.lost else ""
        seconds = " against ".join(f"{s:.2f}" for s in reversed(check.seconds))
        return (
            f"Budget {mm * self.budget:.4g} mm; estimated error of what is off: "
            f"{mm * self.estimate:.4f} mm.",
            f"Checked with everything on, over contacts and seeds kept aside: "
            f"{mm * check.shift:.4f} mm (mean over {check.taxels} taxels); the estimate is "
            f"{ratio:.2f} times that." + lost,
            f"The chosen scene ran in {seconds} s with everything on: {check.faster:.1f} times "
            "faster.",
        )

    def metrics(self) -> dict[str, Any]:
        """The ledger for metrics.json."""
        return {
            "budget_mm": 1e3 * self.budget,
            "estimate_mm": 1e3 * self.estimate,
            "checked_mm": 1e3 * self.check.shift,
            "times_faster": self.check.faster,
            "on": {e.name: e.setting for e in self.entries if e.on},
            "off_mm": {e.name: 1e3 * e.shift for e in self.entries if not e.on},
        }

    def table(self) -> tuple[tuple[str, ...], tuple[tuple[str, ...], ...]]:
        """Header and rows, in words."""
        return HEADER, tuple(entry.row() for entry in self.entries)

    def __str__(self) -> str:
        """The table, with the summary below."""
        header, entries = self.table()
        rows = [header, *entries]
        width = [max(len(row[k]) for row in rows) for k in range(4)]
        lines = [
            f"{row[0]:{width[0]}}  {row[1]:{width[1]}}  {row[2]:>{width[2]}}  "
            f"{row[3]:>{width[3]}}  {row[4]}"
            for row in rows
        ]
        return "\n".join((*lines, *self.summary()))
