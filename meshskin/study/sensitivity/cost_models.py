"""Predictions of seconds and errors of settings from the measured rows of a scene.

Seconds: a fixed part, and parts per step, frame and reading, by non-negative least squares. Errors:
the error by noise is multiplied by the measured factors of lanes, rate and estimator; the numerical
parts of loop, surface, contact model and tolerance add in squares.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from .setting import Setting
from .trial import Row

ONCE = 0.5
"""Part of the seconds of a calibration that does not grow with its readings. Chosen: a prediction
of the seconds is corrected by a measurement of the setting that is chosen."""


@dataclass(frozen=True)
class CostModel:
    """Predictions for one scene."""

    base: Row
    """Row of the scene's own setting."""
    rows: tuple[Row, ...]
    """Rows in which one knob was changed."""
    fixed: float
    """Seconds of every simulation."""
    per_step: float
    """Seconds of each step of the scene's integrator, its planning included."""
    per_frame: float
    """Seconds of each frame in contact."""

    @classmethod
    def fit(cls, rows: Sequence[Row]) -> CostModel:
        """Fit the model to rows in which one knob was changed."""
        from scipy.optimize import nnls

        good = tuple(row for row in rows if not row.failure)
        base = next(row for row in good if row.knob == "scene")
        own = base.setting
        used = [
            row for row in good
            if (row.setting.integrator, row.setting.contact, row.setting.faces)
            == (own.integrator, own.contact, own.faces)
        ]  # fmt: skip
        terms = np.array([[1.0, row.steps, row.contacts] for row in used])
        seconds = np.array([row.seconds["simulate"] for row in used])
        scale = terms.max(axis=0)
        found = nnls(terms / scale / seconds[:, None], np.ones(len(used)))[0] / scale
        return cls(base, good, *(float(x) for x in found))

    def near(self, **knobs: Any) -> Row | None:
        """The row that differs from the base in these knobs only; None if it was not measured."""
        wanted = replace(self.base.setting, **knobs)
        return next((row for row in self.rows if row.setting == wanted), None)

    def seconds(self, setting: Setting) -> float:
        """Processor seconds of load, simulate and calibrate."""
        own, base = setting, self.base
        more = base.setting.lane_spacing / own.lane_spacing
        steps = base.steps * more * base.setting.dt / own.dt
        frames = more * own.rate / base.setting.rate
        loop = self.near(integrator=own.integrator)
        simulate = self.fixed + self.per_step * steps + self.per_frame * base.contacts * frames
        if loop is not None:
            simulate += (loop.seconds["simulate"] - base.seconds["simulate"]) * steps / base.steps
        surface, contact = self.near(faces=own.faces), self.near(contact=own.contact)
        method = self.near(method=own.method)
        if own.method == "joint":
            method = self.near(tolerance=own.tolerance)
        load = (surface or base).seconds["load"]
        simulate += (surface or base).seconds["simulate"] - base.seconds["simulate"]
        calibrate = (method or base).seconds["calibrate"] * (ONCE + (1 - ONCE) * frames)
        if contact is not None:
            calibrate *= contact.seconds["calibrate"] / base.seconds["calibrate"]
            simulate += (contact.seconds["simulate"] - base.seconds["simulate"]) * frames
        return load + max(simulate, self.fixed) + calibrate

    def error(self, setting: Setting) -> tuple[float, float]:
        """Error and numerical part, mm; infinite if a level was not measured or failed."""
        own = setting
        lanes, rate = self.near(lane_spacing=own.lane_spacing), self.near(rate=own.rate)
        method = self.near(method=own.method)
        loop = self.near(dt=own.dt, integrator=own.integrator)
        surface, contact = self.near(faces=own.faces), self.near(contact=own.contact)
        tolerance = self.near(tolerance=own.tolerance)
        parts = (lanes, rate, method, loop, surface, contact, tolerance)
        found = [row for row in parts if row is not None and row.located >= self.base.located]
        if len(found) < len(parts):
            return float("inf"), float("inf")
        error = self.base.error_mm
        for row in found[:3]:
            error *= row.error_mm / max(self.base.error_mm, 1e-12)
        more = [max(row.numerical_mm**2 - self.base.numerical_mm**2, 0.0) for row in found[4:]]
        return error, float(np.sqrt(found[3].numerical_mm ** 2 + sum(more)))

    def settings(self) -> Iterator[Setting]:
        """All combinations of the measured levels."""
        levels = {
            name: list(dict.fromkeys(getattr(row.setting, name) for row in self.rows))
            for name in ("faces", "contact", "lane_spacing", "rate", "method", "tolerance")
        }
        loops = list(dict.fromkeys((r.setting.dt, r.setting.integrator) for r in self.rows))
        own = self.base.setting
        for (dt, integrator), *others in product(loops, *levels.values()):
            knobs = dict(zip(levels, others, strict=True))
            if knobs["method"] == "joint" or knobs["tolerance"] == own.tolerance:
                made = replace(own, dt=dt, integrator=integrator, **knobs)
                if made.whole_frames:
                    yield made

    def cheapest(self, target_mm: float) -> Setting | None:
        """The cheapest combination with error and numerical part within `target_mm`, mm."""
        best, least = None, float("inf")
        for setting in self.settings():
            if np.hypot(*self.error(setting)) <= target_mm:
                seconds = self.seconds(setting)
                if seconds < least:
                    best, least = setting, seconds
        return best
