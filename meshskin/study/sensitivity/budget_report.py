"""The report of a budget: its decisions with their reasons, the estimate and the check."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from ...core.notebook import Card, Tabular

if TYPE_CHECKING:
    import pyarrow as pa
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ...scene.belief import Belief
    from ...scene.scene import Scene

MAX_NAMED = 3
"""Effects that an explanation names."""
HEADER = ("effect", "", "mm", "seconds (saved)", "why")


@dataclass(frozen=True)
class Entry:
    """One effect or knob."""

    name: str
    setting: str
    """"on" or "off"; the level of a knob."""
    on: bool
    """Whether the chosen scene has it; knobs are always on."""
    shift: float
    """Shift of the taxels without it, m, mean over taxels and seeds. Its bound if it was not tried;
    for a knob, the shift of its level against the finest level."""
    seconds: float
    """Seconds that it costs in the whole run."""
    why: str
    """Reason of the decision."""

    @property
    def label(self) -> str:
        """The name for people."""
        return self.name.replace("_", " ")

    @property
    def shift_mm(self) -> float:
        """The shift in mm."""
        return 1e3 * self.shift

    def row(self) -> tuple[str, str, str, str, str]:
        """Name, setting, mm, seconds and reason as text; seconds that are saved are in brackets."""
        seconds = _seconds(self.seconds)
        seconds = seconds if self.on else f"({seconds})"
        return self.label, self.setting, f"{self.shift_mm:.4f}", seconds, self.why


@dataclass(frozen=True)
class Check:
    """Comparison of everything on with the chosen scene, over contacts and seeds kept aside."""

    shift: float
    """Mean shift of the calibrated taxels, m: the true error of what was left out."""
    taxels: int
    """Number of taxels compared."""
    lost: int
    """Number of taxels located with everything on only."""
    seconds: tuple[float, float]
    """Processor seconds of simulation and calibration with everything on, and as chosen."""

    @property
    def faster(self) -> float:
        """Ratio of the seconds with everything on to those of the chosen scene."""
        return self.seconds[0] / max(self.seconds[1], 1e-9)


@dataclass(frozen=True)
class BudgetReport(Card, Tabular):
    """The result of `budget`."""

    budget: float
    """Taxel error, m, that may be left out."""
    entries: tuple[Entry, ...]
    """Effects by decreasing shift, knobs, and effects that were refused."""
    estimate: float
    """Shift of the taxels by all that is off together, m, by the linearized calibration."""
    check: Check
    """Comparison of the estimate with the truth."""
    scene: Scene = field(repr=False)
    """The chosen scene."""
    everything: Scene = field(repr=False)
    """The scene with everything on, at the finest settings."""
    belief: Belief = field(repr=False)
    """Belief of the owner, whatever is on."""
    tolerance: float
    """Newton decrement at which the calibration may stop (`calibrate`'s tolerance)."""

    def __repr__(self) -> str:
        on = sum(entry.on for entry in self.entries)
        return (
            f"<BudgetReport: {on} of {len(self.entries)} on, {1e3 * self.check.shift:.3g} mm of "
            f"{1e3 * self.budget:.3g} mm left out>"
        )

    @property
    def fits(self) -> bool:
        """Whether the true error of what was left out is within the budget, and no taxel lost."""
        return self.check.shift <= self.budget and not self.check.lost

    @property
    def exceeded(self) -> str:
        """Why the true error of what was left out is above the budget; "" where it is not."""
        if self.fits:
            return ""
        off = [entry for entry in self.entries if not entry.on and entry.shift > 0]
        lost = f" {self.check.lost} taxels are lost without what is off;" if self.check.lost else ""
        return (
            f"The budget of {1e3 * self.budget:.4g} mm is exceeded: what is off moves the taxels "
            f"by {1e3 * self.check.shift:.4g} mm together, estimated {1e3 * self.estimate:.4g} mm;"
            f"{lost} largest alone: {_largest(off)}; lower the budget to have more of it simulated"
        )

    def explain(self, error: float) -> str:
        """Why the mean error of a run, m, is above the budget; "" where it is not."""
        if not error > self.budget:
            return ""
        on = [entry for entry in self.entries if entry.on and entry.setting == "on"]
        return (
            f"the mean error of {1e3 * error:.4g} mm is above the budget of "
            f"{1e3 * self.budget:.4g} mm, which bounds what is left out; effects that are on move "
            f"the taxels, too: {_largest(on)}; what the calibration can estimate of them may be "
            "declared unknown (Belief.unknown)"
        )

    @property
    def seconds(self) -> float:
        """Seconds of all that is on in the whole run, by the entries."""
        return sum(entry.seconds for entry in self.entries if entry.on)

    def summary(self) -> tuple[str, ...]:
        """Estimate, truth and speed in sentences."""
        check = self.check
        ratio = self.estimate / check.shift if check.shift > 0 else float("inf")
        lost = f" {check.lost} taxels were found with everything on only." if check.lost else ""
        seconds = " against ".join(f"{s:.2f}" for s in reversed(check.seconds))
        return (
            *((f"{self.exceeded}.",) if self.exceeded else ()),
            f"Budget {1e3 * self.budget:.4g} mm; estimated error of what is off: "
            f"{1e3 * self.estimate:.4f} mm.",
            f"Checked with everything on, over contacts and seeds kept aside: "
            f"{1e3 * check.shift:.4f} mm (mean over {check.taxels} taxels); the estimate is "
            f"{ratio:.2f} times that." + lost,
            f"The chosen scene ran in {seconds} s with everything on: {check.faster:.1f} times "
            "faster.",
        )

    def metrics(self) -> dict[str, Any]:
        """The values for metrics.json."""
        return {
            "budget_mm": 1e3 * self.budget,
            "estimate_mm": 1e3 * self.estimate,
            "checked_mm": 1e3 * self.check.shift,
            "times_faster": self.check.faster,
            "on": {e.name: e.setting for e in self.entries if e.on},
            "off_mm": {e.name: e.shift_mm for e in self.entries if not e.on},
            "summary": list(self.summary()),
            "table": [list(part) for part in self.table()],
        }

    def table(self) -> tuple[tuple[str, ...], tuple[tuple[str, ...], ...]]:
        """Header and rows as text; the seconds of what is on and of the rest add up to the last."""
        measured = self.check.seconds[1]
        rest = "plan, surface, functions, ideal readings: the line below less those above"
        return HEADER, (
            *(entry.row() for entry in self.entries),
            ("the rest", "", "", _seconds(measured - self.seconds), rest),
            ("chosen scene", "", "", _seconds(measured), "measured in the check, processor time"),
        )  # fmt: skip

    def facts(self) -> dict[str, str]:
        """Budget, estimate, check and what is on, for a notebook."""
        on = [entry.label for entry in self.entries if entry.on]
        within = "within the budget" if self.fits else self.exceeded
        return {
            "budget": f"{1e3 * self.budget:.4g} mm",
            "estimated": f"{1e3 * self.estimate:.4g} mm by what is off",
            "checked": f"{1e3 * self.check.shift:.4g} mm, {within}",
            "speed": f"{self.check.faster:.3g} times that of everything on",
            "on": ", ".join(on) or "nothing",
        }

    def plot(self, ax: Axes | None = None) -> Figure:
        """Draw the shift of the taxels without each effect or knob; what is off is grey.

        ax: matplotlib axes; None: those of a new figure.
        """
        from ...core import drawing

        rows = [entry for entry in self.entries if entry.shift > 0]
        names, shifts = [entry.label for entry in rows], [entry.shift_mm for entry in rows]
        on = [entry.on for entry in rows]
        return drawing.bars(ax, names, shifts, "shift without it (mm)", on)

    def to_arrow(self) -> pa.Table:
        """One row an effect or knob: name, setting, on, shift_mm, seconds, why."""
        import pyarrow as pa

        names = ("name", "setting", "on", "shift_mm", "seconds", "why")
        rows = [{name: getattr(entry, name) for name in names} for entry in self.entries]
        return pa.Table.from_pylist(rows)

    def __str__(self) -> str:
        """The table with the summary below it."""
        header, body = self.table()
        rows = [header, *body]
        width = [max(len(row[k]) for row in rows) for k in range(4)]
        lines = [
            f"{row[0]:{width[0]}}  {row[1]:{width[1]}}  {row[2]:>{width[2]}}  "
            f"{row[3]:>{width[3]}}  {row[4]}"
            for row in rows
        ]
        return "\n".join((*lines, *self.summary()))


def _seconds(value: float) -> str:
    """Seconds in milliseconds, without a negative zero."""
    return f"{round(value, 3) + 0.0:.3f}"


def _largest(entries: Sequence[Entry]) -> str:
    """The entries with the largest shifts, in words."""
    most = sorted(entries, key=lambda entry: -entry.shift)[:MAX_NAMED]
    return ", ".join(f"{entry.label} {entry.shift_mm:.3g} mm" for entry in most) or "none"
