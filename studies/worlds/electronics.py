"""From the pressure on taxels to what their electronics write down."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from .profiles import Array

FULL_SCALE = 200.0
"""Counts of the peak pressure; 8 bits end at 255."""
NEIGHBOUR = 1.2
"""Distance of taxels that crosstalk, relative to the least one."""
SLOW = 20.0
"""Ratio of two time constants of creep."""
WARMING = 3.0
"""Time constants of warming during the recording."""


@dataclass(frozen=True)
class Electronics:
    """A taxel's electronics; every standard deviation and level is relative to the peak reading."""

    noise: float = 0.01
    """Standard deviation of a reading's noise."""
    threshold: float = 0.05
    """Readings up to this are not written down."""
    gain: float = 0.0
    """Standard deviation of ln gain over the taxels."""
    offset: float = 0.0
    """Standard deviation of the offsets of the taxels."""
    drift: float = 0.0
    """Standard deviation over the taxels of the rise of the offset during the recording."""
    wander: float = 0.0
    """Standard deviation of the offsets at the end of the recording: random walks from zero."""
    crosstalk: float = 0.0
    """Part of the pressure of each neighbour that a taxel reads."""
    module: int = 0
    """Taxels, about, that share a module, the only ones to crosstalk; 0: all."""
    line: int = 0
    """Taxels of a line of a matrix, in the order of their numbers, each of which reads `crosstalk`
    of every other one; 0: neighbours crosstalk."""
    scan: bool = False
    """Whether a taxel reads `crosstalk` of the one of the last number, and of no other."""
    creep: float = 0.0
    """Relative rise of the reading under a pressure that is held for ever."""
    creep_time: float = 1.0
    """Time constant of that rise, s."""
    slow_creep: float = 0.0
    """As `creep`, beside it, with SLOW times its time constant."""
    warm_gain: float = 0.0
    """Relative rise of the gain of all taxels from a cold to a warm skin."""
    warm_apart: float = 0.0
    """Standard deviation, over the taxels, of ln of the exponent of that rise."""
    warm_offset: float = 0.0
    """Rise of the offset of all taxels from a cold to a warm skin."""
    sag: float = 0.0
    """Part of each reading that is lost where the sum of all readings is its median, as of a supply
    that sags."""
    saturating: bool = False
    """Whether a pressure p reads p / (1 + p / peak): at the peak half of it."""
    second: tuple[int, bool] | None = None
    """Ids of a module, and whether modules alternate: taxels of every other one, or of the second
    half of the modules, saturate as `saturating` has it, the others do not; None: all alike."""
    power: float = 1.0
    """Exponent of a response peak (p / peak)^power."""
    hysteresis: float = 0.0
    """Part of a play operator in the reading."""
    play: float = 0.2
    """Half-width of the play operator, relative to the peak pressure."""
    counts: bool = False
    """Whether readings are integers of 0 to 255, FULL_SCALE at the peak."""

    def response(self, p: Array, peak: float) -> Array:
        """Readings of pressures p, Pa, without noise, before counting."""
        if self.saturating:
            p = p / (1 + p / peak)
        if self.power != 1.0:
            p = np.sign(p) * peak * (np.abs(p) / peak) ** self.power
        return p

    def unit(self, peak: float) -> float:
        """Reading of the peak pressure, Pa."""
        return float(self.response(np.array(peak), peak))


@dataclass(frozen=True)
class Sensors:
    """Electronics of n taxels of one recording, with their random numbers."""

    electronics: Electronics
    peak: float
    """Peak pressure of a taxel at the mean force, Pa."""
    count: int
    """n."""
    seed: int

    def _draw(self, stream: int) -> Array:
        return np.random.default_rng([self.seed, stream]).normal(size=self.count)

    @cached_property
    def gains(self) -> Array:
        """Gains (n,)."""
        return np.exp(self.electronics.gain * self._draw(3))

    def exact(self, pressure: Array, near: Array, time: Array, dwell: Array) -> Array:
        """Readings (m, n) of pressures (m, n), Pa, in time order, without noise and counting.

        near (n, n): distances of the taxels, m, for crosstalk; time, dwell (m,), s: at which each
        contact is read, and for how long it has been held then.
        """
        e, unit = self.electronics, self.electronics.unit(self.peak)
        if e.crosstalk:
            beside = (near > 0) & (near < NEIGHBOUR * near[near > 0].min())
            if e.module:
                module = modules(near, self.count // e.module)
                beside &= module[:, None] == module
            if e.line:
                line = np.arange(self.count) // e.line
                beside = (line[:, None] == line) & (near > 0)
            if e.scan:
                beside = np.eye(self.count, k=1, dtype=bool)
            pressure = pressure + e.crosstalk * pressure @ beside
        if e.creep:
            slow = e.slow_creep * crept(pressure, time, dwell, SLOW * e.creep_time)
            pressure = pressure + e.creep * crept(pressure, time, dwell, e.creep_time) + slow
        if e.hysteresis:
            lagging = play(pressure, e.play * self.peak)
            pressure = (1 - e.hysteresis) * pressure + e.hysteresis * lagging
        reading = e.response(self.gains * pressure, self.peak)
        total = reading.sum(axis=1, keepdims=True)
        reading = reading * (1 - e.sag * total / np.median(total))
        if e.second:
            size, alternating = e.second
            group = np.arange(self.count) // size
            other = group % 2 == 1 if alternating else group > group[-1] // 2
            saturated = replace(e, saturating=True).response(self.gains * pressure, self.peak)
            reading = np.where(other, saturated, reading)
        rise = np.linspace(0.0, 1.0, len(pressure))[:, None]
        warm = 1 - np.exp(-WARMING * rise)
        own = np.exp(e.warm_apart * self._draw(6))
        reading = (1 + e.warm_gain * warm) ** own * reading + unit * e.warm_offset * warm
        steps = np.random.default_rng([self.seed, 10]).normal(size=reading.shape)
        walk = np.cumsum(steps, axis=0) / np.sqrt(len(steps))
        offset = e.offset * self._draw(4) + rise * e.drift * self._draw(5) + e.wander * walk
        return reading + unit * offset

    def recorded(self, exact: Array) -> tuple[Array, float]:
        """What is written down (m, n) for exact readings, and the threshold that it has to pass."""
        e, unit = self.electronics, self.electronics.unit(self.peak)
        rng = np.random.default_rng([self.seed, 6])
        value = exact + e.noise * unit * rng.normal(size=exact.shape)
        if not e.counts:
            return value, e.threshold * unit
        counts = np.clip(np.round(FULL_SCALE * value / unit), 0, 255)
        return counts, float(round(e.threshold * FULL_SCALE))


def modules(near: Array, count: int) -> Array:
    """Modules (n,) of taxels at distances (n, n): around `count` taxels far from each other."""
    centres = [0]
    for _ in range(count - 1):
        centres.append(int(np.argmax(near[:, centres].min(axis=1))))
    return np.asarray(np.argmin(near[:, centres], axis=1))


def play(signal: Array, width: float) -> Array:
    """The play operator of half-width `width` on each column of signals (m, n), from rest.

    Source: Visintin, Differential Models of Hysteresis (1994), section III.1.
    """
    state, out = np.zeros(signal.shape[1]), np.empty_like(signal)
    for k, now in enumerate(signal):
        state = np.clip(state, now - width, now + width)
        out[k] = state
    return out


def crept(signal: Array, time: Array, dwell: Array, constant: float) -> Array:
    """What signals (m, n) approach with a time constant, s, from rest: a Kelvin-Voigt element.

    Each row of the signal is held for `dwell` (m,), s, up to its time (m,), s; before it is zero.
    """
    state, out, last = np.zeros(signal.shape[1]), np.empty_like(signal), time[0] - dwell[0]
    for k, now in enumerate(signal):
        state = state * np.exp(-(time[k] - dwell[k] - last) / constant)
        state = now + (state - now) * np.exp(-dwell[k] / constant)
        out[k], last = state, time[k]
    return out
