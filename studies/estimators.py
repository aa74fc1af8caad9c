"""Every estimator on the same recordings of the paper's sphere, over seeds, against the bound.

    python studies/estimators.py [--scene sphere_noisy] [--seeds 20] [--json FILE]

Prints the mean position error of each method, its ratio to the joint estimate, the expectation of
the Cramer-Rao bound, and the mean NEES with its 95 % band over all seeds and taxels.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

import meshskin as ms
from meshskin.estimation import metrics
from meshskin.estimation.calibrate import METHODS


def main(arguments: list[str] | None = None) -> dict[str, float]:
    """Run the study; return its numbers."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", default="sphere_noisy")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--json", type=Path, default=None)
    options = parser.parse_args(arguments)

    scene = ms.Scene.load(options.scene)
    belief = scene.belief()
    errors: dict[str, list[float]] = {method: [] for method in METHODS}
    bounds, nees = [], []
    for seed in range(options.seeds):
        recording = ms.simulate(scene, seed)
        for method in METHODS:
            found = ms.calibrate(recording, belief, method=method)
            off = metrics.position_errors(found, scene.skin, gauge=method.startswith("posegraph"))
            errors[method].append(1e3 * float(np.nanmean(off)))
            if method == "joint":
                nees.append(float(np.nanmean(metrics.nees(found, scene.skin))))
        bounds.append(1e3 * metrics.cramer_rao(recording, belief, scene.skin).mean)

    numbers = {method: float(np.mean(values)) for method, values in errors.items()}
    numbers["bound"] = float(np.mean(bounds))
    numbers["nees"] = float(np.mean(nees))
    low, high = metrics.nees_band(options.seeds * len(scene.skin))
    print(f"{options.scene}, {options.seeds} seeds: mean position error, mm")
    for method in METHODS:
        ratio = numbers[method] / numbers["joint"]
        print(f"  {method:22} {numbers[method]:9.5f}   {ratio:7.2f} times joint")
    print(f"  {'bound (expectation)':22} {numbers['bound']:9.5f}   joint / bound "
          f"{numbers['joint'] / numbers['bound']:.3f}")  # fmt: skip
    print(f"  NEES {numbers['nees']:.3f}, 95 % band {low:.3f} to {high:.3f}")
    if options.json:
        options.json.write_text(json.dumps(numbers, indent=2))
    return numbers


if __name__ == "__main__":
    main()
