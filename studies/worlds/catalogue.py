"""The worlds by name: foundations and covers, electronics, contact scatter, forces; solvers."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from . import sphere
from .edge import Edge
from .electronics import Electronics
from .outside import Drag, Oblong, Pair, Skewed
from .profiles import Bell, Hertz, Winkler, blurred
from .transducers import Barometer, Capacitor, Magnet
from .world import Radial, World

COVER = 1e-3
"""Standard deviation, m, of the blur by a cover."""


PRESSES: dict[str, Any] = {"dwell": (0.2, 2.0), "lift": 0.5}
"""Contacts that are held for times between these, s, with the indenter lifted between them."""
INDENTER = 0.35e6
"""Hydroelastic modulus, Pa, of an indenter as soft as the body by its depth."""
YIELD = 0.7
"""Pressure at which a skin yields, relative to the elastic peak at the mean force."""
SOLVERS = {
    "rubber_3_bonded": "skfem",
    "rubber_3_sliding": "skfem",
    "rubber_8_bonded": "skfem",
    "rubber_8_sliding": "skfem",
    "pins": "mujoco",
    "hydroelastic": "pydrake",
    "hydroelastic_soft": "pydrake",
    "hydroelastic_counts": "pydrake",
    "wrinkled": "tamaas",
    "yielding": "tamaas",
}
"""Worlds by another solver, and its module."""


EDGES = {"edge": Edge()}
"""Worlds on a body with an edge."""


def world(name: str) -> World | Edge:
    """A world by its name. Raises KeyError, and ImportError without its solver."""
    if name in EDGES:
        return EDGES[name]
    return solved(name) if name in SOLVERS else catalogue()[name]


def names() -> list[str]:
    """All worlds, also those whose solver is not installed."""
    return [*catalogue(), *EDGES, *SOLVERS]


def solved(name: str) -> World:
    """A world of SOLVERS: finite elements, rigid bodies or boundary elements."""
    if SOLVERS[name] == "skfem":
        from .hyperelastic import Layer, stored

        _, thickness, base = name.split("_")
        layer = Layer(thickness=1e-3 * float(thickness), bonded=base == "bonded")
        return World(Radial(stored(layer)))
    if name == "pins":
        from .pins import Pins

        return World(Pins(), guard=90)
    if name.startswith("hydroelastic"):
        from .hydroelastic import Hydroelastic

        if name.endswith("soft"):
            soft = Hydroelastic(indenter_modulus=INDENTER)
            return World(soft, Electronics(gain=0.05), force_error=0.1)
        counts = Electronics(gain=0.05, counts=True)
        rigid = World(Hydroelastic())
        return replace(rigid, electronics=counts, nominal_force=True) if "_" in name else rigid
    from .half_space import Wrinkled, yielding

    if name == "wrinkled":
        return World(Wrinkled())
    peak = float(Hertz()(np.array(0.0), np.array(sphere.FORCE)))
    return World(Radial(yielding(YIELD * peak)))


@cache
def catalogue() -> dict[str, World]:
    """Worlds in closed form, by name."""
    hertz, foam, cover = Radial(Hertz()), Radial(Winkler()), Radial(blurred(Winkler(), COVER))
    together = Electronics(gain=0.1, offset=0.01, saturating=True, hysteresis=0.5)
    counts = Electronics(gain=0.1, saturating=True, counts=True)
    return {
        "hertz": World(hertz),
        "foam": World(foam),
        "foam_cover": World(cover),
        "bell": World(Radial(Bell())),
        "barometer": World(Radial(Barometer())),
        "capacitor": World(Radial(Capacitor())),
        "magnet": World(Radial(Magnet())),
        "saturating": World(hertz, Electronics(saturating=True)),
        "two_skins": World(hertz, Electronics(second=(12, False))),
        "two_amplifiers": World(hertz, Electronics(second=(12, True))),
        "power": World(cover, Electronics(power=0.6)),
        "force_10": World(hertz, force_error=0.1),
        "force_nominal": World(hertz, nominal_force=True),
        "multiplexed": World(hertz, skew=0.5),
        "scan_places": World(hertz, skew=0.1, order="places"),
        "scan_drawn": World(hertz, skew=0.1, order="drawn"),
        "force_drift": World(foam, force_drift=0.2),
        "scatter_03": World(hertz, scatter=0.3e-3),
        "scatter_10": World(hertz, scatter=1e-3),
        "strays": World(hertz, Electronics(gain=0.1), strays=0.05),
        "hysteresis": World(hertz, Electronics(hysteresis=0.5)),
        "together": World(hertz, together, scatter=0.3e-3, force_error=0.1),
        "uneven_05": World(hertz, uneven=0.05),
        "uneven_20": World(hertz, uneven=0.2),
        "counts": World(hertz, counts, scatter=0.3e-3, nominal_force=True),
        "drift": World(hertz, Electronics(drift=0.05)),
        "crosstalk": World(hertz, Electronics(crosstalk=0.05)),
        "crosstalk_modules": World(hertz, Electronics(crosstalk=0.05, module=12)),
        "crosstalk_faint": World(hertz, Electronics(crosstalk=0.02, module=12)),
        "matrix": World(hertz, Electronics(crosstalk=0.03, line=10)),
        "ghosts": World(hertz, Electronics(crosstalk=0.03, scan=True)),
        "wander": World(hertz, Electronics(wander=0.03)),
        "creep_03": World(hertz, Electronics(creep=0.25, creep_time=0.3), **PRESSES),
        "creep_30": World(hertz, Electronics(creep=0.25, creep_time=3.0), **PRESSES),
        "creep_stops": World(hertz, Electronics(creep=0.25), dwell=(0.1, 1.5)),
        "creep_slides": World(hertz, Electronics(creep=0.25)),
        "creep_twice": World(hertz, Electronics(creep=0.3, creep_time=0.1, slow_creep=0.15)),
        "warming": World(hertz, Electronics(warm_gain=0.1, warm_offset=0.03)),
        "warming_apart": World(foam, Electronics(warm_gain=0.3, warm_apart=0.4)),
        "sagging": World(foam, Electronics(gain=0.1, sag=0.1)),
        "drag_01": World(Drag(hertz, 0.1e-3)),
        "drag_09": World(Drag(hertz, 0.9e-3)),
        "skewed": World(Skewed(Hertz(), 5.3e-3)),
        "pair": World(Pair(hertz)),
        "oblong_13": World(Oblong(Hertz(), 1.3)),
        "oblong_13_turns": World(Oblong(Hertz(), 1.3, turns=True)),
        "oblong_20": World(Oblong(Hertz(), 2.0)),
        "oblong_20_turns": World(Oblong(Hertz(), 2.0, turns=True)),
    }
