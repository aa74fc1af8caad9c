"""Units that are mixed up: found by what no scene within reason explains, and named."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ...core.errors import CalibrationError
from ...core.se3 import Array
from ...geometry.body import Body

FAR_OFF = 0.02
"""Most by which contact points may typically lie off the believed surface, m."""
SCALES = (1e-3, 1e3, 1e-6, 1e6)
"""Errors of scale that mixing up m, mm and um causes."""
CLOSE = 2e-3
"""Typical distance from the surface, m, below which rescaled points are on it, and size above which
they are not one point: a tenth of FAR_OFF."""
SAMPLES = 100
"""Points that are rescaled, about: a median needs no more."""
PRESSURE = 30.0
"""Most by which the strongest readings may differ from the believed peak pressure."""
FEW = 3
"""Readings of a taxel of which the strongest is taken for its strongest."""
FORCE = 100.0
"""Most by which forces may differ from the reference."""
PRESSURES = {"kPa": 1e-3, "MPa": 1e-6, "bar": 1e-5, "psi": 6894.76**-1}
"""Number that stands for one Pa where a pressure was written in this unit."""
FORCES = {"kN": 1e-3, "mN": 1e3, "uN": 1e6}
"""Number that stands for one N."""
REMEDY = "check the units of pressure, force and modulus"


def check_place(body: Body, points: Array, distance: Array) -> None:
    """Refuse contact points (m, 3) far from the surface: `distance` (m,), m, from it.

    A unit that would put them on the surface is named. Raises CalibrationError.
    """
    typical = float(np.median(np.abs(distance))) if len(distance) else 0.0
    if typical <= FAR_OFF:
        return
    some = points[:: max(len(points) // SAMPLES, 1)]
    on_surface = [
        factor
        for factor in SCALES
        if np.ptp(factor * some, axis=0).max() > CLOSE
        and np.median(np.abs(body.closest(factor * some).distance)) < CLOSE
    ]
    raise CalibrationError(
        "the contact points are not on the believed body",
        value=f"typically {typical:.3g} m off its surface",
        limit=f"{FAR_OFF} m",
        remedy=f"times {on_surface[0]:g} they are on it: correct their unit, which a column of a "
        "log names (px_mm, px_um)"
        if on_surface
        else "check their units (m) and that they are in the body's frame",
    )


def check_force(force: Array, reference: float) -> None:
    """Refuse forces (m,), N, that are nowhere near the reference, N."""
    typical = float(np.median(force)) if len(force) else reference
    ratio = typical / reference
    if not 1 / FORCE < ratio < FORCE:
        raise CalibrationError(
            "the forces cannot be in N",
            value=f"typically {typical:.3g}",
            limit=f"the reference force is {reference:.3g} N",
            remedy=_guess(ratio, FORCES, "N") + REMEDY,
        )


def check_pressure(pressure: Array, taxel: np.ndarray, peaks: Array) -> None:
    """Refuse readings (k,), Pa, of the taxels (k,) that no modulus within reason explains.

    peaks (m,), Pa: those of the believed contacts.
    """
    if not len(pressure):
        return
    strongest = np.zeros(int(taxel.max()) + 1)
    np.maximum.at(strongest, taxel, pressure)
    told = np.bincount(taxel) >= FEW  # of fewer, all may be at the rims of their contacts
    if not told.any():
        return
    typical, expected = float(np.median(strongest[told])), float(np.median(peaks))
    ratio = typical / expected
    if not 1 / PRESSURE < ratio < PRESSURE:
        raise CalibrationError(
            "the pressures cannot be in Pa",
            value=f"a taxel's strongest reading is typically {typical:.3g}",
            limit=f"the believed contacts peak at {expected:.3g} Pa",
            remedy=_guess(ratio, PRESSURES, "Pa") + REMEDY,
        )


def _guess(ratio: float, units: Mapping[str, float], meant: str) -> str:
    """What a number that is `ratio` of the one expected looks like, in words; "" for nothing."""
    near = min(units, key=lambda name: abs(np.log(ratio / units[name])))
    alike = 0.05 < ratio / units[near] < 20
    return f"they look like {near} taken for {meant}; " if alike else ""
