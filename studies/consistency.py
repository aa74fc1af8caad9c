"""Whether the joint estimate's certainty is right: normalised squared errors over many seeds.

    python studies/consistency.py [--scenes ideal modulus ...] [--seeds 40] [--full] [--json FILE]

Scenes on the paper's sphere, 1 % noise, 40 taxels and 800 contacts of 2 to 4 N: the ideal model; E*
unknown and 20 % off; gains 5 % apart; gains and offsets; a force sensor with a bias; an indenter
that stands 0.4 mm off; rigid modules that lie on the body to 0.1 mm a taxel. For the position along
the surface, the tilt, the spin (of modules), each shared unknown, the gains and the offsets: mean
squared error over its stated variance, 1 where the covariance holds, with the band that it keeps to
in 95 of 100 such studies. RMS error over the Cramer-Rao bound; and how often the test of fit is
wrong at 1e-3.
--full takes 200 seeds.
"""

from __future__ import annotations

import argparse
import json
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import chi2

import meshskin as ms
from meshskin import se3
from meshskin.estimation import metrics
from meshskin.estimation.factors.module import SURFACE
from meshskin.estimation.factors.shared import PRIORS
from meshskin.estimation.observe import TILT_SIGMA
from meshskin.geometry import slots
from meshskin.geometry.region import Cap
from meshskin.physics.effects.force_sensor import ForceSensor
from meshskin.physics.effects.gain_offset import GainOffset
from meshskin.physics.effects.gaussian_noise import GaussianNoise
from meshskin.physics.effects.indenter_offset import IndenterOffset

NOISE, TAXELS, CONTACTS = 0.01, 40, 800
OFFSET = (3e-4, -2e-4, 1e-4)
SPREAD, OFFSETS = 0.05, 0.005
"""Standard deviations of ln(gain), and of the offsets in units of the peak."""
BIAS = 0.1
"""Of the force sensor, N."""
SEEN = 0.5
"""Part of its prior's standard deviation below which an unknown counts as determined by data."""


class Case(NamedTuple):
    """A world, and what its owner believes."""

    world: ms.Scene
    belief: dict[str, Any]
    truth: dict[str, float]
    """Shared unknowns by label."""


def cases() -> dict[str, Case]:
    """The scenes by name."""
    base = ms.Scene.load("sphere_noisy")
    skin = ms.Skin.cover(base.body, 5e-3, TAXELS, Cap((0, 0, -1), 0.5))
    ideal = base.with_(skin=skin, effects=(GaussianNoise(NOISE),))
    softer = ms.Material(0.8 * base.material.young, base.material.poisson)
    gains = ideal.with_(effects=(*ideal.effects, GainOffset(SPREAD, 0.0)))
    offsets = ideal.with_(effects=(*ideal.effects, GainOffset(SPREAD, OFFSETS)))
    biased = ideal.with_(effects=(*ideal.effects, ForceSensor(0.0, BIAS)))
    displaced = ideal.with_(effects=(*ideal.effects, IndenterOffset(OFFSET)))
    modules = ms.Skin.modules(base.body, 7, region=Cap((0, 0, -1), 0.5)).skin
    stands = {f"indenter_offset {axis}": -value for axis, value in zip("xyz", OFFSET, strict=True)}
    off = {"modulus": float(np.log(1 / 0.8))}
    return {
        "ideal": Case(ideal, {"unknown": ()}, {}),
        "modulus": Case(ideal, {"material": softer}, off),
        "gains": Case(
            gains,
            {"unknown": ("modulus", "gain"), "priors": {"gain": SPREAD}},
            {"modulus": 0.0},
        ),
        "offsets": Case(
            offsets,
            {
                "unknown": ("modulus", "gain", "offset"),
                "priors": {"gain": SPREAD, "offset": OFFSETS},
            },
            {"modulus": 0.0},
        ),
        "force": Case(
            biased,
            {"unknown": ("modulus", "force_scale", "force_offset")},
            {"modulus": 0.0, "force_scale": 0.0, "force_offset": -BIAS},
        ),
        "indenter": Case(
            displaced, {"unknown": ("modulus", "indenter_offset")}, {"modulus": 0.0} | stands
        ),
        "modules": Case(
            ideal.with_(skin=modules), {"module_slots": slots.OFFSETS}, {"modulus": 0.0}
        ),
    }


def contacts(scene: ms.Scene) -> dict[str, np.ndarray]:
    """Points (m, 3), m, over the skin and a patch's radius beyond, forces (m,), N, spins, rad."""
    rng, centre = np.random.default_rng(7), scene.skin.positions.mean(axis=0)
    reach = np.linalg.norm(scene.skin.positions - centre, axis=1).max() + scene.patch.semi_axes[0]
    count = round(CONTACTS * len(scene.skin) / TAXELS)
    k = np.arange(count) + 0.5
    angle, radius = np.pi * (3 - np.sqrt(5)) * k, reach * np.sqrt(k / count)
    flat = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(count)])
    return {
        "points": scene.body.closest(centre + flat).point,
        "force": rng.uniform(2.0, 4.0, count),
        "spin": rng.uniform(-np.pi, np.pi, count),
    }


def study(case: Case, seeds: int) -> dict[str, dict[str, float]]:
    """Rows of quantities: mean normalised square, its band, how many squares it is a mean of."""
    world, belief = case.world, case.world.belief(**case.belief)
    right = replace(belief, material=world.material)  # the bound is that at the truth
    pressed = contacts(world)
    squares: dict[str, list[np.ndarray]] = defaultdict(list)
    errors, bounds, chances = [], [], []
    modular = belief.module_slots is not None
    one = np.flatnonzero(slots.slot(world.skin.ids) == slots.CENTRE) if modular else slice(None)
    for seed in range(seeds):
        if modular:
            world = world.with_(skin=settled(case.world.skin, np.random.default_rng(seed)))
        recording = ms.press(world, **pressed, seed=seed)
        found = ms.calibrate(recording, belief)
        off = pose_errors(found, world.skin)[one]
        if not modular:  # the surface is as true as it is trusted to be
            off[:, 3:5] += np.random.default_rng(seed).normal(scale=TILT_SIGMA, size=(len(off), 2))
        seen, covariance = found.observed[one], found.covariances[one]
        for name, columns in (("position", [0, 1]), ("tilt", [3, 4]), ("spin", [5])):
            good = seen[:, columns].all(axis=1)
            part = covariance[np.ix_(good, columns, columns)]
            solved = np.linalg.solve(part, off[good][:, columns, None])[:, :, 0]
            squares[name].append(off[good][:, columns] * solved)
        for label, true in case.truth.items():
            value, sigma = found.unknowns[label]
            if sigma < SEEN * prior(label):
                squares[label].append(np.array([((value - true) / sigma) ** 2]))
        for name, true in taxels(world, seed).items():
            if name in found.taxel_unknowns:
                value, sigma = found.taxel_unknowns[name].T
                squares[name].append(((value - true) / sigma) ** 2)
        chances.append(found.fit.p)
        if not modular:
            errors.append(np.mean(metrics.position_errors(found, world.skin) ** 2))
            bounds.append(metrics.cramer_rao(recording, right, world.skin).rms ** 2)
    rows = {}
    for name, parts in squares.items():
        values = np.concatenate([part.ravel() for part in parts])
        if len(values):
            low, high = chi2.ppf([0.025, 0.975], len(values)) / len(values)
            rows[name] = {"nees": values.mean(), "low": low, "high": high, "count": len(values)}
    rows["fit"] = {"false_alarms": float(np.mean(np.array(chances) < 1e-3))}
    if errors:
        rows["fit"]["rms_over_bound"] = float(np.sqrt(np.mean(errors) / np.mean(bounds)))
    return {name: {key: float(v) for key, v in row.items()} for name, row in rows.items()}


def taxels(world: ms.Scene, seed: int) -> dict[str, np.ndarray]:
    """ln(gain) and offset (Pa) of the world's taxels (n,), as GainOffset draws them."""
    context = world.context(seed)
    stream, n = context.stream("gain_offset"), len(world.skin)
    gain = SPREAD * stream.standard_normal(n)
    return {"gain": gain, "offset": OFFSETS * context.peak_pressure * stream.standard_normal(n)}


def settled(skin: ms.Skin, rng: np.random.Generator) -> ms.Skin:
    """The skin with its modules as near to the surface as the estimator believes them to be.

    Each is moved along its normal and tilted as a plane through ten heights is that scatter so.
    """
    offsets = slots.OFFSETS[slots.slot(skin.ids)].reshape(-1, len(slots.TAXELS), 3)
    plane = np.stack([np.ones(offsets.shape[:2]), offsets[..., 1], -offsets[..., 0]], axis=2)
    heights = rng.normal(scale=SURFACE, size=offsets.shape[:2])
    lift = np.einsum("mij,mj->mi", np.linalg.pinv(plane), heights)
    none = np.zeros(len(lift))
    move = se3.transform(
        se3.exp_so3(np.column_stack([lift[:, 1:], none])), np.column_stack([none, none, lift[:, 0]])
    )
    own = se3.transform(np.eye(3), offsets)
    middle = skin.poses.reshape(*own.shape[:2], 4, 4)[:, 0] @ se3.inverse(own[:, 0])
    poses = (middle @ move)[:, None] @ own
    return ms.Skin(poses.reshape(-1, 4, 4), skin.ids, skin.disc_radius)


def prior(label: str) -> float:
    """Standard deviation of a shared unknown before any data."""
    return PRIORS[label.split()[0]]


def pose_errors(found: ms.Calibration, skin: ms.Skin) -> np.ndarray:
    """Errors (n, 6), true less found, in the taxels' frames; the spin against the true one."""
    row = {int(k): r for r, k in enumerate(skin.ids)}
    true = skin.poses[[row[int(k)] for k in found.ids]]
    turn = np.swapaxes(found.poses[:, :3, :3], 1, 2)
    moved = np.einsum("nij,nj->ni", turn, true[:, :3, 3] - found.positions)
    # the spin is a convention where it is not observed: the tilt is that of the normal
    normal = np.einsum("nij,nj->ni", turn, true[:, :3, 2])
    tilt = np.column_stack([-normal[:, 1], normal[:, 0]])
    spin = se3.log_so3(np.where(np.isfinite(turn), turn, np.eye(3)) @ true[:, :3, :3])[:, 2]
    return np.column_stack([moved, tilt, spin])


def main(arguments: list[str] | None = None) -> dict[str, dict[str, dict[str, float]]]:
    """Run the scenes; return their rows."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", nargs="+", default=None)
    parser.add_argument("--seeds", type=int, default=None)
    parser.add_argument("--full", action="store_true", help="200 seeds")
    parser.add_argument("--json", type=Path, default=None)
    options = parser.parse_args(arguments)
    seeds = options.seeds or (200 if options.full else 40)
    chosen = {name: case for name, case in cases().items() if name in (options.scenes or cases())}

    found = {}
    print(f"normalised squared errors, {seeds} seeds")
    for name, case in chosen.items():
        found[name] = study(case, seeds)
        fit = found[name]["fit"]
        ratio = f", rms / bound {fit['rms_over_bound']:.3f}" if "rms_over_bound" in fit else ""
        print(f"{name}: fit refused in {fit['false_alarms']:.1%} of the runs{ratio}")
        for quantity, row in found[name].items():
            if quantity != "fit":
                inside = row["low"] < row["nees"] < row["high"]
                print(f"  {quantity:20} {row['nees']:6.3f}   95 % band {row['low']:.3f} to "
                      f"{row['high']:.3f}   of {row['count']:,.0f}"
                      f"{'' if inside else '   outside'}", flush=True)  # fmt: skip
    if options.json:
        options.json.write_text(json.dumps(found, indent=2))
    return found


if __name__ == "__main__":
    main()
