"""What the measured rows say of settings that were not measured: their seconds and their errors.

Seconds: fixed, and for each step, frame and reading, by non-negative least squares. Errors: noise
goes with the lanes, the rate and the estimator, each by its own measured factor; the numerical
parts of loop, surface, contact and tolerance add in squares.
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
"""Part of a calibration's seconds that does not grow with its readings."""


@dataclass(frozen=True)
class Models:
    """Predictions about one scene from the rows of its ladders; `base` is the scene's own row."""

    base: Row
    rows: tuple[Row, ...]
    fixed: float
    """Seconds of every simulation."""
    a_step: float
    """Seconds of each step of the base's integrator, its path included."""
    a_frame: float
    """Seconds of each frame in contact."""

    @classmethod
    def fit(cls, rows: Sequence[Row]) -> Models:
        """From rows in which each knob was turned by itself."""
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
        """The row at the base's setting but for some knobs; None if it was not measured."""
        wanted = replace(self.base.setting, **knobs)
        return next((row for row in self.rows if row.setting == wanted), None)

    def seconds(self, setting: Setting) -> float:
        """Processor seconds of load, simulate and calibrate."""
        own, base = setting, self.base
        more = base.setting.lane_spacing / own.lane_spacing
        steps = base.steps * more * base.setting.dt / own.dt
        frames = more * own.rate / base.setting.rate
        loop = self.near(integrator=own.integrator)
        simulate = self.fixed + self.a_step * steps + self.a_frame * base.contacts * frames
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
        """Error and numerical part, mm; infinite where a knob's level was not measured or fails."""
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
        """Every combination of the measured levels."""
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
        """The cheapest combination whose error and numerical part stay within `target_mm`."""
        best, least = None, float("inf")
        for setting in self.settings():
            if np.hypot(*self.error(setting)) <= target_mm:
                seconds = self.seconds(setting)
                if seconds < least:
                    best, least = setting, seconds
        return best
