"""An accuracy or a time asked for, and what a pilot run (pilot.py) promises of every setting.

Errors follow from the pilot's Cramér-Rao bound, which goes with the contacts to the power -1/2,
from what the scene's effects leave behind without noise, and from the numerical parts of the levels
of every other knob, which are tried on its path (levels.py). Nothing is kept from machine to
machine, or from run to run.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from ...core.errors import ConfigError, StudyError
from .levels import Level
from .setting import RATES, Setting

LANES = tuple(2.0 ** (k / 2) for k in range(-6, 2))
"""Spacings of lanes that may be chosen, over the scene's own."""
SAFE = 0.9
"""Part of the accuracy asked for that a promise may use up: errors scatter from run to run."""


@dataclass(frozen=True)
class Request:
    """What is asked of a run: one of the two."""

    accuracy_mm: float | None = None
    """Mean error of the taxels; the cheapest setting is chosen."""
    seconds: float | None = None
    """Of the whole run, pilot and report included; the most accurate setting is chosen."""

    def __post_init__(self) -> None:
        given = [v for v in (self.accuracy_mm, self.seconds) if v is not None]
        if len(given) != 1:
            raise ConfigError("an accuracy or a time can be asked for", remedy="give one of them")
        if not (np.isfinite(given[0]) and given[0] > 0):
            what = "an accuracy" if self.seconds is None else "a time"
            raise ConfigError(
                f"{what} that is asked for must be finite", value=self.words, limit="above 0"
            )

    @property
    def words(self) -> str:
        """What is asked for."""
        if self.accuracy_mm is not None:
            return f"{self.accuracy_mm:g} mm"
        return f"{self.seconds:g} s"


@dataclass(frozen=True)
class Prediction:
    """A setting, and what a run with it should come to."""

    setting: Setting
    error_mm: float
    """Mean error of the taxels against the truth."""
    numerical_mm: float
    """Shift of the taxels by step, integrator, contact model and surface, as far as they were
    tried."""
    seconds: float
    """Of the whole run by the clock on the wall, what is already spent included."""
    processor_seconds: float


@dataclass(frozen=True)
class Pilot:
    """What a short run showed; seconds are processor time."""

    base: Setting
    """The scene's own setting."""
    setting: Setting
    """The pilot's."""
    steps: int
    contacts: int
    readings: int
    bound_mm: float
    """Mean error at the Cramér-Rao bound; 0 without noise."""
    systematic_mm: float
    """Mean error without noise."""
    knobs: tuple[tuple[Level, ...], ...]
    """The levels of every knob beside lanes and rate that was tried, the scene's own first."""
    fixed: float
    """Making the loop, writing, and drawing the report."""
    each_step: float
    """Planning and running."""
    each_contact: float
    """Reading the skin."""
    estimating: tuple[float, float]
    """Fixed, and for each reading: of the estimate and all that runs beside it."""
    spent: tuple[float, float]
    """On the wall and of the processor, from the run's beginning until the pilot was over."""

    @property
    def slowdown(self) -> float:
        """Seconds on the wall for each of the processor, as the machine was under the pilot."""
        return max(self.spent[0] / max(self.spent[1], 1e-9), 1.0)

    def promise(self, setting: Setting, levels: Sequence[Level] = ()) -> Prediction:
        """Of a setting of lanes and rate, with these levels of other knobs."""
        lanes = self.setting.lane_spacing / setting.lane_spacing
        many = lanes * setting.rate / self.setting.rate
        error = float(np.hypot(self.bound_mm / np.sqrt(many), self.systematic_mm))
        once, each = self.estimating
        more = self.fixed + self.each_step * self.steps * lanes
        more += self.each_contact * self.contacts * many + once + each * self.readings * many
        for level, (own, *_) in zip(levels, self.knobs, strict=bool(levels)):
            more += level.once - own.once + (level.along - own.along) * lanes
            more += (level.reading - own.reading) * many
            setting = replace(setting, **level.changes)
            error = float(np.hypot(error, level.error_mm))
        return Prediction(
            setting,
            error,
            float(np.sqrt(sum(level.numerical_mm**2 for level in levels))),
            self.spent[0] + more * self.slowdown,
            self.spent[1] + more,
        )

    def promises(self) -> list[Prediction]:
        """Of all settings that may be chosen."""
        widest = self.setting.lane_spacing * (1 + 1e-9)
        lanes = [self.base.lane_spacing * factor for factor in LANES]
        lanes = [x for x in lanes if x < widest] + [self.setting.lane_spacing]
        made = [
            self.promise(replace(self.base, lane_spacing=x, rate=self.base.rate * r), levels)
            for x in dict.fromkeys(lanes)
            for r in RATES
            for levels in product(*self.knobs)
        ]
        return [promise for promise in made if promise.setting.whole_frames]

    def choose(self, request: Request) -> list[Prediction]:
        """The settings that keep a request, the best first. Raises StudyError if none does."""
        promises = self.promises()

        def total(p: Prediction) -> float:
            return float(np.hypot(p.error_mm, p.numerical_mm))

        if request.accuracy_mm is not None:
            kept = [p for p in promises if total(p) <= SAFE * request.accuracy_mm]
            if kept:
                return sorted(kept, key=lambda p: p.processor_seconds)
            best = min(promises, key=total)
            raise StudyError(
                "the accuracy is out of reach",
                value=request.words,
                limit=f"{total(best):.3g} mm in {best.seconds:.3g} s at best",
                remedy="quieter taxels, or fewer effects that the calibration does not know",
            )
        assert request.seconds is not None
        kept = [p for p in promises if p.seconds <= request.seconds]
        if kept:
            return sorted(kept, key=lambda p: (total(p), p.seconds))
        quick = min(promises, key=lambda p: p.seconds)
        raise StudyError(
            "the time is too short",
            value=request.words,
            limit=f"{quick.seconds:.3g} s for {total(quick):.3g} mm at least",
            remedy="give more seconds",
        )
