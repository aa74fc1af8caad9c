"""A request for an accuracy or a time, and the predictions of a pilot run (pilot.py) for it.

Predicted errors follow from the Cramér-Rao bound of the pilot, which is proportional to the number
of contacts to the power -1/2, from the error that the scene's effects leave without noise, and from
the measured errors of the levels of the other knobs. Nothing is stored between runs or
machines.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np

from ...core.errors import ConfigError, StudyError
from .knobs import Level
from .setting import Setting

SAFE = 0.9
"""Part of the accuracy asked for that a prediction may use: errors scatter between seeds."""


@dataclass(frozen=True)
class Request:
    """A request for a run: an accuracy or a time."""

    accuracy_mm: float | None = None
    """Mean error of the taxels; the cheapest setting is chosen."""
    seconds: float | None = None
    """Time of the whole run with pilot and report; the most accurate setting is chosen."""

    def __post_init__(self) -> None:
        given = [v for v in (self.accuracy_mm, self.seconds) if v is not None]
        if len(given) != 1:
            raise ConfigError("an accuracy or a time can be asked for", remedy="give one of them")
        if not (np.isfinite(given[0]) and given[0] > 0):
            kind = "accuracy" if self.seconds is None else "time"
            raise ConfigError(
                f"the {kind} asked for must be positive and finite",
                value=self.words,
                limit="above 0",
            )

    @property
    def words(self) -> str:
        """The value with its unit."""
        if self.accuracy_mm is not None:
            return f"{self.accuracy_mm:g} mm"
        return f"{self.seconds:g} s"


@dataclass(frozen=True)
class Prediction:
    """A setting with the predicted error and seconds of a run."""

    setting: Setting
    error_mm: float
    """Mean error of the taxels against the truth."""
    numerical_mm: float
    """Shift of the taxels by time step, integrator, contact model and surface, if measured."""
    seconds: float
    """Wall time of the whole run, including what is already spent."""
    processor_seconds: float
    """Processor time of the whole run, including what is already spent."""

    @property
    def total_mm(self) -> float:
        """Root of the sum of squares of error and numerical part."""
        return float(np.hypot(self.error_mm, self.numerical_mm))


@dataclass(frozen=True)
class Pilot:
    """The measurements of a short run, or of the rows of `cost`; seconds are processor time."""

    base: Setting
    """Setting of the scene."""
    setting: Setting
    """Setting of the pilot."""
    steps: int
    contacts: int
    readings: int
    bound_mm: float
    """Mean error at the Cramér-Rao bound; 0 without noise."""
    systematic_mm: float
    """Mean error without noise."""
    lane_spacings: tuple[float, ...]
    """Spacings of lanes that may be chosen, m."""
    rates: tuple[float, ...]
    """Frames per second that may be chosen."""
    knobs: tuple[tuple[Level, ...], ...]
    """Measured levels of each other knob, the scene's own level first."""
    fixed: float
    """Seconds of compiling the loop, writing, and drawing the report."""
    each_step: float
    """Seconds of planning and running a step."""
    each_contact: float
    """Seconds of reading the skin in a contact."""
    estimating: tuple[float, float]
    """Fixed seconds, and seconds per reading, of the estimate and all methods run beside it."""
    spent: tuple[float, float]
    """Wall and processor seconds from the beginning of the run to the end of the pilot."""
    shares: Mapping[str, float] = field(default_factory=dict)
    """Part of `estimating` that each method takes."""

    def estimate_seconds(self, method: str, readings: int) -> float:
        """Processor seconds of one method on so many readings."""
        once, each = self.estimating
        return self.shares.get(method, 1.0) * (once + each * readings)

    @property
    def slowdown(self) -> float:
        """Wall time over processor time during the pilot."""
        return max(self.spent[0] / max(self.spent[1], 1e-9), 1.0)

    def growth(self, setting: Setting) -> float:
        """Contacts of a run at `setting` over those of the pilot."""
        lanes = self.setting.lane_spacing / setting.lane_spacing
        return lanes * setting.rate / self.setting.rate

    def predict(self, setting: Setting, levels: Sequence[Level] = ()) -> Prediction:
        """The prediction for lanes and rate of `setting`, with these levels of the other knobs."""
        lanes = self.setting.lane_spacing / setting.lane_spacing
        many = self.growth(setting)
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

    def predictions(self) -> list[Prediction]:
        """The predictions for all settings that may be chosen."""
        settings = product(self.lane_spacings, self.rates, product(*self.knobs))
        made = [
            self.predict(replace(self.base, lane_spacing=lanes, rate=rate), levels)
            for lanes, rate, levels in settings
        ]
        return [prediction for prediction in made if prediction.setting.whole_frames]

    def choose(self, request: Request) -> list[Prediction]:
        """The predictions that fulfil a request, the best first. Raises StudyError if none does."""
        predictions = self.predictions()
        if request.accuracy_mm is not None:
            kept = [p for p in predictions if p.total_mm <= SAFE * request.accuracy_mm]
            if kept:
                return sorted(kept, key=lambda p: p.processor_seconds)
            best = min(predictions, key=lambda p: p.total_mm)
            raise StudyError(
                "the accuracy is out of reach",
                value=request.words,
                limit=f"{best.total_mm:.3g} mm in {best.seconds:.3g} s at best",
                remedy="use quieter taxels, or fewer effects that the calibration does not model",
            )
        assert request.seconds is not None
        kept = [p for p in predictions if p.seconds <= request.seconds]
        if kept:
            return sorted(kept, key=lambda p: (p.total_mm, p.seconds))
        quick = min(predictions, key=lambda p: p.seconds)
        raise StudyError(
            "the time is too short",
            value=request.words,
            limit=f"{quick.seconds:.3g} s for {quick.total_mm:.3g} mm at least",
            remedy="give more seconds",
        )
