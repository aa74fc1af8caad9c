"""Lags of the readings behind the pressure, beyond those that the estimate has.

Covers and electronics relax with a distribution of time constants, and the loops of hysteresis are
those of a distribution of play operators. An estimate has one of each, and none where no single one
shows. A lag displaces the taxels along the motion of the contacts, which hardly shows in the
residuals: it shifts all taxels that are crossed in one direction alike. What is left of it is
therefore estimated at the end (small_effects.py): creep with each of several time constants and
play of each of several widths, a Prony series and a Prandtl-Ishlinskii operator.

Source: Visintin, Differential Models of Hysteresis (1994), section III.2.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ...core.arrays import Array
from ..joint.departures import WIDTHS, FittedReadings
from ..joint.electronics import WIDTH, Electronics
from ..joint.held_lags import contact_leverages
from ..joint.small_effects import SmallEffects, shared_effects

LAGS = "lags of the readings with several time constants or widths"
MAX_LEVERAGE = 0.1
"""Mean leverage of the contacts' errors from which lags are not looked for: how well these errors
are determined depends on the lags, which a likelihood at its mode leaves out. With 0.5 (counts of
studies/foreign_worlds.py) shares were found that are none, in four of seven recordings, and 1.4 to
1.7 times the error stated; with lags there 0.8 to 1.0 without them. With 0.01 to 0.04 (creep_twice
there, Preisach's operator, two time constants) they were right."""


def lags(
    fitted: FittedReadings, beyond_mode: Callable[[Callable[[FittedReadings], Array]], Array]
) -> SmallEffects:
    """The lags of the readings beyond those in `fitted`; beyond_mode: the slope of the marginal
    likelihood less that at the mode, of parameters whose derivatives a function gives
    (marginal_slope.py)."""
    columns = _columns(fitted)
    slope, information = fitted.shared(columns)
    slope = np.where(np.diag(information) > 0, slope + beyond_mode(_columns), 0.0)
    return shared_effects(fitted, columns, slope, information)


def _columns(fitted: FittedReadings) -> Array:
    """Derivatives (k, q) of the readings in the shares of creep and play."""
    electronics = Electronics(fitted.data, fitted.readings, fitted.points)
    pressure = np.maximum(fitted.mu - fitted.offset, 0.0)
    halves = (np.full(len(pressure), width * WIDTH * electronics.peak) for width in WIDTHS)
    plays = [electronics.play(pressure, half)[0] - pressure for half in halves]
    return np.column_stack([fitted.creeps(electronics), *plays])


def contact_leverage(fitted: FittedReadings) -> float:
    """Mean leverage of the readings in the errors of their contacts, the other unknowns known."""
    return float(np.mean(contact_leverages(fitted)))
