"""Spacing of the lanes and contacts of an exploration, for a wanted number of contacts.

The error of a taxel falls with the square root of the number of contacts that it feels.
"""

from __future__ import annotations

import numpy as np

from ..core.errors import ReachError

MIN_SPACING = 0.05
"""Least spacing of lanes, relative to the sensing radius: a taxel then feels 1,000 contacts of that
spacing, far more than the 20 to 100 that explorations have."""
MAX_SPACING = 0.75
"""Largest spacing of lanes, relative to the sensing radius. With wider ones some taxels get only
the rims of contacts: for the same mean error they need 1.1 times the contacts of close lanes at
0.75, 1.2 to 1.5 times at 0.85, 2 to 3 times at 0.9 (ellipsoid and capsule, by
studies/contact_design.py)."""


def spacing_for(radius: float, contacts: float, step: float) -> float:
    """Spacing of lanes, m, at which a taxel gets about `contacts` contacts, from two lanes or more.

    radius: the sensing radius, m; step: between contacts along a lane, m. A taxel feels contacts on
    an area pi radius^2.
    """
    return float(min(MAX_SPACING * radius, np.pi * radius**2 / (contacts * step)))


def check_spacing(spacing: float, radius: float) -> None:
    """Raise ReachError for lanes `spacing`, m, apart, closer than MIN_SPACING of a sensing radius,
    m: the number of contacts grows with 1 / spacing^2."""
    if spacing < MIN_SPACING * radius:
        raise ReachError(
            "the contacts of the exploration would be too close to one another",
            value=f"lanes {1e3 * spacing:.2g} mm apart",
            limit=f"{1e3 * MIN_SPACING * radius:.2g} mm, {MIN_SPACING:g} of what a taxel feels",
            remedy="ask for fewer contacts or wider lanes, read the skin more often, or go slower",
        )
