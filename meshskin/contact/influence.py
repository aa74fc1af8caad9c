"""Surface displacement caused by pressure on a grid: elastic half-space and bonded elastic layer.

A point force P displaces the surface of a half-space by P / (pi E* r); in Fourier space pressure of
wavenumber k is multiplied by 2 / (E* k). For a layer of thickness t bonded to a rigid base, with a
frictionless surface, this is multiplied by

    L(z) = (2 kappa sinh 2z - 4 z) / (2 kappa cosh 2z + 4 z^2 + 1 + kappa^2),
    z = k t, kappa = 3 - 4 nu.

L - 1 decays as exp(-2 z): the influence of the layer is that of the half-space (exact for a
rectangle) plus the smooth D(r/t) / (pi E* t), D(x) = integral_0^inf (L(z) - 1) J_0(z x) dz. There
are no periodic images in either case, and all Poisson's ratios including 1/2 are covered.

Source: A. E. H. Love, Phil. Trans. R. Soc. A 228 (1929); K. L. Johnson, "Contact Mechanics" (1985),
eq. 3.25; I. I. Vorovich, V. M. Aleksandrov, V. A. Babeshko, "Non-classical mixed problems of the
theory of elasticity" (1974).
"""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np

from ..core.arrays import Array
from ..core.errors import ContactError

LEAST_CELLS = 1.0
"""Smallest thickness of a layer in grid cells: D is smooth on the scale of the thickness."""
_MAX_Z = 22.0
"""End of the integral: exp(-2 z) z^2 is 4e-17 there, below double precision."""


class Influence:
    """u = K p on a grid of `shape` (n, m) cells of `spacing` (dx, dy), m; `modulus`: E*, Pa.

    `thickness` of the bonded layer, m; None for a half-space. Raises ContactError where the layer
    is too thin for the grid.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        spacing: tuple[float, float],
        modulus: float,
        poisson: float,
        thickness: float | None = None,
    ) -> None:
        from scipy import fft

        self.shape = shape
        quadrant = _rectangle(shape, spacing)
        if thickness is not None:
            quadrant += _layer(shape, spacing, poisson, thickness)
        self.padded = tuple(fft.next_fast_len(2 * n - 1, real=True) for n in shape)
        kernel = np.zeros(self.padded)
        n, m = shape
        kernel[:n, :m] = quadrant
        kernel[-(n - 1) :, :m] = quadrant[:0:-1]
        kernel[:, -(m - 1) :] = kernel[:, m - 1 : 0 : -1]
        self._spectrum = fft.rfft2(kernel / (math.pi * modulus)).real  # even in x and y

    def __call__(self, pressure: Array) -> Array:
        """Displacement (n, m), m, into the body under `pressure` (n, m), Pa."""
        from scipy import fft

        spectrum = fft.rfft2(pressure, self.padded)
        spectrum *= self._spectrum
        n, m = self.shape
        return np.asarray(fft.irfft2(spectrum, self.padded, overwrite_x=True)[:n, :m])


def layer_factor(z: Array, poisson: float) -> Array:
    """L(z) - 1 of a bonded layer, without cancellation or overflow."""
    kappa = 3 - 4 * poisson
    s = np.exp(-2 * z)
    top = 2 * kappa * s**2 + (4 * z**2 + 4 * z + 1 + kappa**2) * s
    return np.asarray(-top / (kappa * (1 + s**2) + (4 * z**2 + 1 + kappa**2) * s))


def _rectangle(shape: tuple[int, int], spacing: tuple[float, float]) -> Array:
    """pi E* u at cells (i, j) from unit pressure on cell (0, 0) of a half-space."""
    x, y = ((np.arange(n + 1) - 0.5)[:, None] * d for n, d in zip(shape, spacing, strict=True))
    y = y.T
    corner = x * np.arcsinh(y / np.abs(x)) + y * np.arcsinh(x / np.abs(y))
    return np.asarray(np.diff(np.diff(corner, axis=0), axis=1))


def _layer(
    shape: tuple[int, int], spacing: tuple[float, float], poisson: float, thickness: float
) -> Array:
    """pi E* times the change of `_rectangle` by the rigid base, mean over a cell."""
    dx, dy = (d / thickness for d in spacing)
    if max(dx, dy) * LEAST_CELLS > 1:
        raise ContactError(
            "the layer is too thin for the grid",
            value=f"thickness/cell = {1 / max(dx, dy):.2f}",
            limit=f">= {LEAST_CELLS:g}",
            remedy="use a finer grid",
        )
    rho = np.hypot(np.arange(shape[0])[:, None] * dx, np.arange(shape[1]) * dy)
    # mean over a square cell: a Gaussian of the same variance, exact to fourth order
    variance = round((dx * dx + dy * dy) / 24, 6)
    reach = 2.0 ** math.ceil(math.log2(float(rho[-1, -1])))
    return np.asarray(_difference(poisson, variance, reach)(rho) * (dx * dy * thickness))


@functools.lru_cache(maxsize=64)
def _difference(poisson: float, variance: float, reach: float) -> Any:
    """D(x) as a spline on 0 <= x <= reach; variance: of the cell, in units of t^2."""
    from scipy.interpolate import CubicSpline
    from scipy.special import j0, roots_legendre

    x, weight = roots_legendre(64 + int(_MAX_Z * reach / 2))
    z = _MAX_Z / 2 * (1 + x)
    weight = _MAX_Z / 2 * weight * layer_factor(z, poisson) * np.exp(-variance * z**2 / 2)
    knots = np.linspace(0.0, reach, 65 + int(12 * reach))
    return CubicSpline(knots, j0(knots[:, None] * z) @ weight)
