"""Wrong beliefs: whether the test of fit rejects them, and the error with the unknown declared.

    python studies/beliefs.py [--seeds 5] [--json FILE] [--out DIR]

The paper's sphere with 1 % noise, with four differences between world and belief: a skin 20 %
softer than believed; an indenter displaced by 1 mm; layers of 4 and 1.5 mm on a rigid base that are
believed to be half-spaces of the same E*. Each is calibrated with the wrong belief, and with the
unknown declared: E*; the indenter's offset; E* (a half-space of another E* represents a layer that
is not thin); the layer itself. The study prints the mean error over the Cramér-Rao bound at the
truth, also of the centroid of contact points, which rests on no belief, and the share of runs in
which the test of fit rejects the model. With --out, it draws these errors.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from dots import dots
from setups import spiral

import meshskin as ms
from meshskin.core.atomic_io import write_json
from meshskin.core.errors import MeshskinError
from meshskin.effects.indenter_offset import IndenterOffset
from meshskin.estimation.uncertainty import metrics
from meshskin.report import theme

CONTACTS = 2000


class Case(NamedTuple):
    """A world, a belief that is wrong about it, and one that declares the unknown."""

    world: ms.Scene
    wrong: dict[str, Any]
    declared: dict[str, Any]
    right: dict[str, Any]
    """What is unknown even to whom the rest is known: the bound is that of this."""


def cases() -> dict[str, Case]:
    """The differences by name."""
    base = ms.Scene.load("sphere_noisy")
    stiffer = ms.Material(base.material.young / 0.8, base.material.poisson)
    displaced = base.with_(effects=(*base.effects, IndenterOffset((1e-3, 0.0, 0.0))))
    both = {"unknown": ("modulus", "indenter_offset")}
    half_space = {"contact": "hertz", "material": base.material}
    found = {
        "E* 20 % off": Case(base, {"material": stiffer, "unknown": ()}, {"material": stiffer}, {}),
        "indenter 1 mm off": Case(displaced, {}, both, both),
    }
    for thickness, declared in ((4e-3, half_space), (1.5e-3, {})):
        layer = ms.Material(base.material.young, base.material.poisson, thickness)
        world = base.with_(contact="layered", material=layer)
        believed = half_space | {"unknown": ()}
        name = f"layer of {1e3 * thickness:g} mm for half-space"
        found[name] = Case(world, believed, declared, {})
    return found


def contacts(scene: ms.Scene) -> tuple[np.ndarray, np.ndarray]:
    """Contact points (m, 3), m, all over the skin, and spins (m,), rad, that vary."""
    points = scene.body.closest(spiral(scene.skin, CONTACTS, 4e-3)).point
    return points, np.random.default_rng(3).uniform(-np.pi, np.pi, CONTACTS)


def study(case: Case, seeds: int) -> dict[str, float]:
    """Mean errors over the bound, and shares of runs that the test of fit refuses."""
    points, spins = contacts(case.world)
    skin = case.world.skin
    beliefs = {
        "wrong": case.world.belief(**case.wrong),
        "declared": case.world.belief(**case.declared),
    }
    right = case.world.belief(**case.right)
    totals: dict[str, list[float]] = {
        f"{name}_{what}": [] for name in beliefs for what in ("error", "refused")
    }
    bounds, centroids = [], []
    for seed in range(seeds):
        recording = ms.press(case.world, points, spin=spins, seed=seed)
        bounds.append(metrics.cramer_rao(recording, right, skin).mean)
        baseline = ms.calibrate(recording, right, method="centroid")
        centroids.append(float(np.nanmean(metrics.position_errors(baseline, skin))))
        for name, belief in beliefs.items():
            try:
                found = ms.calibrate(recording, belief)
            except MeshskinError:
                totals[f"{name}_error"].append(np.inf)
                totals[f"{name}_refused"].append(1.0)
                continue
            off = metrics.position_errors(found, skin)
            totals[f"{name}_error"].append(float(np.nanmean(off)))
            totals[f"{name}_refused"].append(float(found.fit is not None and not found.fit.good))
    row = {name: float(np.mean(values)) for name, values in totals.items()}
    bound = float(np.mean(bounds))
    return {
        "bound_mm": 1e3 * bound,
        "wrong": row["wrong_error"] / bound,
        "wrong_refused": row["wrong_refused"],
        "declared": row["declared_error"] / bound,
        "declared_refused": row["declared_refused"],
        "centroid": float(np.mean(centroids)) / bound,
    }


def main(arguments: list[str] | None = None) -> dict[str, dict[str, float]]:
    """Run all cases; return their rows."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--json", type=Path, default=None)
    parser.add_argument("--out", type=Path, default=None, help="folder of the figure")
    options = parser.parse_args(arguments)
    rows = {name: study(case, options.seeds) for name, case in cases().items()}
    print(f"mean error over the bound, and runs whose model is refused; {options.seeds} seeds")
    print(f"  {'':32}{'as believed':>20}{'declared':>20}{'centroid':>10}{'bound (mm)':>14}")
    for name, r in rows.items():
        cells = (f"{r[k]:11.2f}{r[k + '_refused']:9.0%}" for k in ("wrong", "declared"))
        print(f"  {name:32}" + "".join(cells) + f"{r['centroid']:10.2f}{r['bound_mm']:14.4f}")
    if options.json:
        write_json(options.json, rows)
    if options.out:
        kinds = {"as believed": "wrong", "with the unknown declared": "declared"}
        kinds["centroid"] = "centroid"
        shown = {name: {k: r[key] for k, key in kinds.items()} for name, r in rows.items()}
        theme.save(dots(shown, "mean error / bound", limits={"bound": 1.0}), options.out, "beliefs")
    return rows


if __name__ == "__main__":
    main()
