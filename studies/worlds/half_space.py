"""Elastic half-spaces by boundary elements, with tamaas: a wrinkled skin, and a yielding one."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import tamaas
from scipy.ndimage import map_coordinates, spline_filter

from . import sphere
from .profiles import FORCES, Array, Hertz, Tabulated
from .sphere import Touch

SIDE, CELLS = 0.016, 64
"""Side, m, of the square about a contact point in which pressures are found, and cells along it."""
CELL = SIDE / CELLS
CENTRES = (np.arange(CELLS) + 0.5) * CELL - SIDE / 2
MODULUS = Hertz().modulus
"""E*, Pa; tamaas gets pressures in E* and lengths in mm, because steps of its solver by Stanley and
Kato have no scale."""
MM, TOLERANCE = 1e-3, 1e-6

tamaas.set_log_level(tamaas.LogLevel.error)


def _model() -> tamaas.Model:
    """A half-space without periodic images."""
    shape = [CELLS, CELLS]
    size = [SIDE / MM, SIDE / MM]
    model = tamaas.ModelFactory.createModel(tamaas.model_type.basic_2d, size, shape)
    model.E, model.nu = 1.0, 0.0
    tamaas.ModelFactory.registerNonPeriodic(model, "dcfft")
    return model


def pressures(gap: Array, force: float, limit: float = np.inf) -> Array:
    """Pressures (CELLS, CELLS), Pa, of a gap (CELLS, CELLS), m, closed by a force, N.

    limit: pressure, Pa, that is not passed. Source: Polonsky and Keer, Wear 231 (1999); with a
    limit Stanley and Kato, J. Tribology 119 (1997), as tamaas bounds it.
    """
    model = _model()
    if np.isinf(limit):
        solver = tamaas.PolonskyKeerRey(model, -gap / MM, TOLERANCE)
    else:
        solver = tamaas.KatoSaturated(model, -gap / MM, TOLERANCE, limit / MODULUS)
    solver.setIntegralOperator("dcfft")
    solver.solve(force / SIDE**2 / MODULUS)
    return MODULUS * np.array(model.traction)


def indenter_gap() -> Array:
    """Parabolic gap (CELLS, CELLS), m, between the smooth body and the indenter."""
    square = CENTRES[:, None] ** 2 + CENTRES**2
    return np.asarray(square / 2 * (1 / sphere.INDENTER_RADIUS + 1 / sphere.RADIUS))


@dataclass(frozen=True)
class Wrinkled:
    """Pressures on a skin with a rough surface, fixed to it: no two contacts are alike."""

    rms: float = 1e-4
    """Root mean square height, m."""
    longest: float = 8e-3
    """Longest wavelength, m; the spectrum falls as for a Hurst exponent of 0.8 to the shortest."""
    shortest: float = 1e-3
    seed: int = 0

    @cached_property
    def heights(self) -> Array:
        """Heights (k, k), m, on a square grid of cells CELL over the skin's plane, periodic."""
        k = 2 * round(0.06 / CELL)
        frequency = np.fft.fftfreq(k, CELL)
        wave = np.hypot(frequency[:, None], frequency)
        inside = (wave >= 1 / self.longest) & (wave <= 1 / self.shortest)
        amplitude = np.where(inside, np.maximum(wave, 1.0) ** -1.8, 0.0)
        white = np.random.default_rng([self.seed, 8]).normal(size=(k, k))
        height = np.fft.ifft2(amplitude * np.fft.fft2(white)).real
        return np.asarray(self.rms * height / height.std())

    @cached_property
    def _coefficients(self) -> Array:
        return np.asarray(spline_filter(self.heights, order=3, mode="grid-wrap"))

    def __call__(self, touch: Touch, positions: Array) -> Array:
        """Means (m, n), Pa, of the pressure over the taxels' discs."""
        flat, places = plane(touch.points), plane(positions)
        smooth, nodes = indenter_gap(), sphere.disc_nodes()
        last = SIDE / 2 + sphere.DISC_RADIUS
        out = np.zeros((len(flat), len(places)))
        half = len(self.heights) // 2
        for k, (centre, force) in enumerate(zip(flat, touch.force, strict=True)):
            x, y = (half + (c + CENTRES) / CELL for c in centre)
            grid = np.meshgrid(x, y, indexing="ij")
            height = map_coordinates(
                self._coefficients, grid, order=3, mode="grid-wrap", prefilter=False
            )
            pressure = pressures(smooth - height, float(force))
            near = np.flatnonzero(np.hypot(*(places - centre).T) < last)
            at = (places[near, None] + nodes - centre) / CELL + (CELLS - 1) / 2
            values = map_coordinates(pressure, at.transpose(2, 0, 1), order=1)
            out[k, near] = values.mean(axis=1)
        return out


def plane(points: Array) -> Array:
    """Arc lengths and headings (k, 2), m, of points of the sphere from its pole."""
    across = np.hypot(points[:, 0], points[:, 1])
    length = sphere.RADIUS * np.arctan2(across, points[:, 2])
    return points[:, :2] * (length / np.maximum(across, 1e-300))[:, None]


def yielding(limit: float) -> Tabulated:
    """The profile under a sphere where pressures end at `limit`, Pa: a skin that yields.

    Elastic elsewhere.
    """
    r, gap = np.arange(0.0, SIDE / 2, CELL / 4), indenter_gap()
    rows = [ring_means(pressures(gap, float(force), limit), r) for force in FORCES]
    return Tabulated(r, FORCES, np.array(rows))


def ring_means(pressure: Array, r: Array) -> Array:
    """Means (k,) of a field over circles of radii r (k,), m."""
    angle = np.pi * (np.arange(48) + 0.5) / 24
    at = np.stack([np.multiply.outer(r, np.cos(angle)), np.multiply.outer(r, np.sin(angle))])
    places = at / CELL + (CELLS - 1) / 2
    return np.asarray(map_coordinates(pressure, places, order=1).mean(axis=1))
