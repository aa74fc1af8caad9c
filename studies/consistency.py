"""Consistency of the joint estimate: normalized squared errors over many seeds.

    python studies/consistency.py [--scenes ideal modulus ...] [--seeds 40] [--first 0] [--full]
                                  [--json FILE] [--out DIR]

Scenes on the paper's sphere with 1 % noise, 40 taxels and 800 contacts of 2 to 4 N: the ideal
model; E* unknown and 20 % off; gains 5 % apart; gains and offsets; a force sensor with a bias, and
one with a scale error of 5 %; an indenter displaced by 0.3 mm (1 sigma, random) along each axis;
rigid modules that lie on the body within 0.1 mm per taxel; and 80 taxels on an ellipsoid that is
mounted 0.4 mm and 5 mrad off. For the position along the surface, the tilt, the spin (of modules),
each shared unknown, the gains and the offsets, the study prints the mean squared error over its
stated variance, which is 1 for a correct covariance, with its 95 % band. Taxels that share an
unknown have correlated errors: the band is that of the effective number of independent squares,
from the scatter between seeds (the design effect).

Of forty such quantities, two are outside their bands by chance. The verdict is therefore on all of
them together, by Holm's method with a level of 5 %. It and the RMS errors, which may be 1.05 times
the Cramér-Rao bound, determine the exit code. The test of fit has a level of 0.1 %. --full: 200
seeds; --first: the first seed; --out: folder of a figure of all quantities in their bands.
"""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from dots import dots
from scipy.stats import chi2
from setups import spiral

import meshskin as ms
from meshskin.core import se3
from meshskin.core.atomic_io import write_json
from meshskin.core.se3 import TURN_PER_METRE
from meshskin.effects.body_pose import BodyPose
from meshskin.effects.force_sensor import ForceSensor
from meshskin.effects.gain_offset import GainOffset
from meshskin.effects.gaussian_noise import GaussianNoise
from meshskin.effects.indenter_offset import IndenterOffset
from meshskin.estimation.data.global_parameters import PRIORS
from meshskin.estimation.joint.module_parametrization import SURFACE_SIGMA
from meshskin.estimation.uncertainty import metrics
from meshskin.estimation.uncertainty.observability import TILT_SIGMA
from meshskin.geometry.region import Cap
from meshskin.report import theme
from meshskin.skin import slots

NOISE, TAXELS, CONTACTS = 0.01, 40, 800
STANDS = 3e-4
"""Standard deviation of each coordinate of the indenter's offset, m."""
SPREAD, OFFSETS = 0.05, 0.005
"""Standard deviations of ln(gain), and of the offsets in units of the peak."""
BIAS, SCALE = 0.1, 0.05
"""Of the force sensor: a constant, N, and the logarithm of true over recorded force."""
SHIFT, TURN = (3e-4, -2e-4, 2e-4), (4e-3, -3e-3, 2e-3)
"""Of the body on the arm, m and rad."""
RMS = 1.05
"""Most RMS error over the Cramer-Rao bound."""
FEW = 20
"""Seeds below which their scatter tells nothing: all squares of a seed count as one, then."""
LEVEL = 0.05
"""Probability that the verdict is wrong where all covariances hold."""
SEEN = 0.5
"""Part of its prior's standard deviation below which an unknown counts as determined by data."""


Draw = Callable[[ms.Scene, np.random.Generator], tuple[ms.Scene, dict[str, float]]]
"""The world of a seed, and its shared unknowns that are drawn from their priors."""


class Case(NamedTuple):
    """A world, and what its owner believes."""

    world: ms.Scene
    belief: dict[str, Any]
    truth: dict[str, float]
    """Shared unknowns by label."""
    recorded_force: float = 1.0
    """What the force sensor says of a newton."""
    draw: Draw | None = None
    """What is another in every world."""


def cases() -> dict[str, Case]:
    """The scenes by name."""
    base = ms.Scene.load("sphere_noisy")
    skin = ms.Skin.cover(base.body, 5e-3, TAXELS, Cap((0, 0, -1), 0.5))
    ideal = base.with_(skin=skin, effects=(GaussianNoise(NOISE),))
    softer = ms.Material(0.8 * base.material.young, base.material.poisson)
    gains = ideal.with_(effects=(*ideal.effects, GainOffset(SPREAD, 0.0)))
    offsets = ideal.with_(effects=(*ideal.effects, GainOffset(SPREAD, OFFSETS)))
    biased = ideal.with_(effects=(*ideal.effects, ForceSensor(0.0, BIAS)))
    modules = ms.Skin.modules(base.body, 7, region=Cap((0, 0, -1), 0.5)).skin
    off = {"modulus": float(np.log(1 / 0.8))}
    body = ms.Body.ellipsoid((0.05, 0.07, 0.035))
    seated = base.with_(
        body=body,
        contact="elliptic",
        skin=ms.Skin.cover(body, 7e-3, 2 * TAXELS, Cap((0, 0, -1), 1.2)),
        effects=(*ideal.effects, BodyPose(SHIFT, TURN)),
    )
    sits = [*(-se3.exp_so3(np.negative(TURN)) @ SHIFT), *np.negative(TURN)]
    axes = ("x", "y", "z", "rotation x", "rotation y", "rotation z")
    at = {f"body_offset {axis}": float(value) for axis, value in zip(axes, sits, strict=True)}
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
        "force scale": Case(
            ideal,
            {"unknown": ("modulus", "force_scale")},
            {"modulus": 0.0, "force_scale": SCALE},
            np.exp(-SCALE),
        ),
        "body": Case(
            # a prior so wide that what is found is found from the readings
            seated,
            {"unknown": ("modulus", "body_offset"), "priors": {"body_offset": 0.02}},
            {"modulus": 0.0} | at,
        ),
        "indenter": Case(
            ideal,
            {
                "unknown": ("modulus", "indenter_offset", "drag", "friction"),
                "priors": {"indenter_offset": STANDS},
            },
            {"modulus": 0.0, "drag": 0.0, "friction": 0.0},
            draw=random_displacement,
        ),
        "modules": Case(
            ideal.with_(skin=modules),
            {},
            {"modulus": 0.0},
            draw=random_mounting,
        ),
    }


def contacts(scene: ms.Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (m, 3), m, over the skin and a patch's radius beyond, forces (m,), N, spins, rad."""
    rng, positions = np.random.default_rng(7), scene.skin.positions
    reach, count = scene.patch.semi_axes[0], round(CONTACTS * len(scene.skin) / TAXELS)
    if scene.skin.normals @ scene.axis @ np.ones(len(positions)) > 0.9 * len(positions):
        points = spiral(scene.skin, count, reach)
    else:  # all round: about the taxels
        near = positions[np.arange(count) % len(positions)]
        points = near + rng.uniform(-2 * reach, 2 * reach, (count, 3))
    force, spin = rng.uniform(2.0, 4.0, count), rng.uniform(-np.pi, np.pi, count)
    return scene.body.closest(points).point, force, spin


def study(case: Case, seeds: range) -> dict[str, dict[str, float]]:
    """Rows of quantities: mean normalized square, its band, how many squares it is a mean of."""
    belief = case.world.belief(**case.belief)
    right = replace(belief, material=case.world.material)  # the bound is that at the truth
    points, force, spin = contacts(case.world)
    squares: dict[str, list[np.ndarray]] = defaultdict(list)
    errors, bounds, chances = [], [], []
    for seed in seeds:
        world, truth = case.world, case.truth
        if case.draw is not None:
            world, drawn = case.draw(case.world, np.random.default_rng(seed))
            truth = truth | drawn
        pressed = ms.press(world, points, force, spin, seed)
        recording = pressed.with_columns(force=case.recorded_force * pressed.force)
        found = ms.calibrate(recording, belief)
        for name, part in (
            pose_squares(found, world.skin, belief, seed)
            | shared_squares(found, truth, belief)
            | taxel_squares(found, taxels(world, seed))
        ).items():
            squares[name].append(part)
        assert found.fit is not None  # a joint estimate has one
        chances.append(found.fit.p)
        if belief.module_slots is None:
            errors.append(np.mean(metrics.position_errors(found, world.skin) ** 2))
            bounds.append(metrics.cramer_rao(recording, right, world.skin).rms ** 2)
    rows = {}
    for name, parts in squares.items():
        values = np.concatenate([part.ravel() for part in parts])
        if len(values):
            rows[name] = band(values.mean(), len(values) / design_effect(parts))
    rows["fit"] = {"false_alarms": float(np.mean(np.array(chances) < 1e-3))}
    if errors:
        rows["fit"]["rms_over_bound"] = float(np.sqrt(np.mean(errors) / np.mean(bounds)))
    return {name: {key: float(v) for key, v in row.items()} for name, row in rows.items()}


def pose_squares(
    found: ms.Calibration, skin: ms.Skin, belief: ms.Belief, seed: int
) -> dict[str, np.ndarray]:
    """Squared errors (n, freedoms) over their variance: along the surface, tilt and spin.

    The sum over a row's freedoms is chi-square. Of rigid modules their central taxels stand for
    them.
    """
    off, seen, covariance = pose_errors(found, skin), found.observed, found.covariances
    if belief.module_slots is None:  # the surface is as true as it is trusted to be
        off[:, 3:5] += np.random.default_rng(seed).normal(scale=TILT_SIGMA, size=(len(off), 2))
    else:
        one = slots.slot(skin.ids) == slots.CENTRE
        off, seen, covariance = off[one], seen[one], covariance[one]
    out = {}
    for name, freedoms in (("position", [0, 1]), ("tilt", [3, 4]), ("spin", [5])):
        columns = np.array(freedoms)
        good = seen[:, columns].all(axis=1)
        part = covariance[np.ix_(np.flatnonzero(good), columns, columns)]
        solved = np.linalg.solve(part, off[good][:, columns, None])[:, :, 0]
        out[name] = off[good][:, columns] * solved
    return out


def shared_squares(
    found: ms.Calibration, truth: dict[str, float], belief: ms.Belief
) -> dict[str, np.ndarray]:
    """The same (1,) of each shared unknown that the data determine."""
    out = {}
    for label, true in truth.items():
        value, sigma = found.unknowns[label]
        if sigma < SEEN * prior(label, belief):
            out[label] = np.array([((value - true) / sigma) ** 2])
    return out


def taxel_squares(found: ms.Calibration, truth: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The same (n,) of the gains and offsets, where they were estimated."""
    out = {}
    for name, true in truth.items():
        if name in found.taxel_unknowns:
            value, sigma = found.taxel_unknowns[name].T
            out[name] = ((value - true) / sigma) ** 2
    return out


def taxels(world: ms.Scene, seed: int) -> dict[str, np.ndarray]:
    """ln(gain) and offset (Pa) of the world's taxels (n,), as GainOffset draws them."""
    context = world.context(seed)
    stream, n = context.stream("gain_offset"), len(world.skin)
    gain = SPREAD * stream.standard_normal(n)
    return {"gain": gain, "offset": OFFSETS * context.peak_pressure * stream.standard_normal(n)}


def random_displacement(
    scene: ms.Scene, rng: np.random.Generator
) -> tuple[ms.Scene, dict[str, float]]:
    """The indenter stands off."""
    offset = STANDS * rng.standard_normal(3)
    x, y, z = map(float, offset)
    labels = (f"indenter_offset {axis}" for axis in "xyz")
    world = scene.with_(effects=(*scene.effects, IndenterOffset((x, y, z))))
    return world, {label: -float(value) for label, value in zip(labels, offset, strict=True)}


def random_mounting(scene: ms.Scene, rng: np.random.Generator) -> tuple[ms.Scene, dict[str, float]]:
    """The skin's modules are as near to the surface as the estimator believes them to be.

    Each is moved along its normal and tilted as a plane through ten heights is that scatter so.
    """
    skin = scene.skin
    offsets = slots.OFFSETS[slots.slot(skin.ids)].reshape(-1, len(slots.TAXELS), 3)
    plane = np.stack([np.ones(offsets.shape[:2]), offsets[..., 1], -offsets[..., 0]], axis=2)
    heights = rng.normal(scale=SURFACE_SIGMA, size=offsets.shape[:2])
    lift = np.einsum("mij,mj->mi", np.linalg.pinv(plane), heights)
    none = np.zeros(len(lift))
    move = se3.transform(
        se3.exp_so3(np.column_stack([lift[:, 1:], none])), np.column_stack([none, none, lift[:, 0]])
    )
    own = se3.transform(np.eye(3), offsets)
    middle = skin.poses.reshape(*own.shape[:2], 4, 4)[:, 0] @ se3.inverse(own[:, 0])
    poses = (middle @ move)[:, None] @ own
    return scene.with_(skin=ms.Skin(poses.reshape(-1, 4, 4), skin.ids, skin.disc_radius)), {}


def design_effect(parts: list[np.ndarray]) -> float:
    """Variance of the seeds' mean squares over that of independent ones; no less than 1.

    parts: squares (n,), or (n, 2) of two degrees of freedom each, of each seed. Source: Kish,
    "Survey Sampling" (1965), section 8.2.
    """
    means = np.array([part.mean() for part in parts if part.size])
    size = np.mean([part.size for part in parts if part.size])
    if len(means) < FEW:
        return float(size)
    return float(max(np.var(means, ddof=1) * size / 2, 1.0))


def band(nees: float, count: float) -> dict[str, float]:
    """The row of a mean of `count` normalized squares: its 95 % band, and its p, of two sides."""
    low, high = chi2.ppf([0.025, 0.975], count) / count
    below = chi2.cdf(nees * count, count)
    p = 2 * min(below, 1 - below)
    return {"nees": nees, "low": low, "high": high, "count": count, "p": p}


def inconsistent(found: dict[str, dict[str, dict[str, float]]]) -> list[str]:
    """What cannot be chance: quantities by Holm's method at LEVEL, and RMS errors beyond RMS.

    Source: Holm, "A simple sequentially rejective multiple test procedure", Scand. J. Statistics 6
    (1979).
    """
    rows = [
        (row["p"], f"{scene}: {name}, {row['nees']:.3f}, p = {row['p']:.1e}")
        for scene, quantities in found.items()
        for name, row in quantities.items()
        if name != "fit"
    ]
    out = []
    for place, (p, words) in enumerate(sorted(rows)):
        if p > LEVEL / (len(rows) - place):
            break
        out.append(words)
    for scene, quantities in found.items():
        ratio = quantities["fit"].get("rms_over_bound", 1.0)
        if ratio > RMS:
            out.append(f"{scene}: rms / bound {ratio:.3f}")
    return out


def prior(label: str, belief: ms.Belief) -> float:
    """Standard deviation of a shared unknown before any data."""
    name = label.split()[0]
    sigma = belief.priors.get(name, PRIORS[name])
    return sigma * TURN_PER_METRE if "rotation" in label else sigma


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
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--full", action="store_true", help="200 seeds")
    parser.add_argument("--json", type=Path, default=None)
    parser.add_argument("--out", type=Path, default=None, help="folder of the figure")
    options = parser.parse_args(arguments)
    seeds = range(options.first, options.first + (options.seeds or (200 if options.full else 40)))
    chosen = {name: case for name, case in cases().items() if name in (options.scenes or cases())}

    found = {}
    print(f"normalized squared errors, {len(seeds)} seeds from {seeds[0]}")
    for name, case in chosen.items():
        found[name] = study(case, seeds)
        fit = found[name]["fit"]
        ratio = f", rms / bound {fit['rms_over_bound']:.3f}" if "rms_over_bound" in fit else ""
        print(f"{name}: fit refused in {fit['false_alarms']:.1%} of the runs{ratio}")
        for quantity, row in found[name].items():
            if quantity != "fit":
                inside = row["low"] < row["nees"] < row["high"]
                print(f"  {quantity:24} {row['nees']:6.3f}   95 % band {row['low']:.3f} to "
                      f"{row['high']:.3f}   of {row['count']:7,.0f}   p = {row['p']:.2g}"
                      f"{'' if inside else '   outside'}", flush=True)  # fmt: skip
    every = [row for rows in found.values() for name, row in rows.items() if name != "fit"]
    outside = sum(not row["low"] < row["nees"] < row["high"] for row in every)
    out = inconsistent(found)
    print(f"{outside} of {len(every)} outside their 95 % bands, {0.05 * len(every):.1f} by chance")
    print(f"beyond chance{':' if out else ': none'}", *out, sep="\n  ")
    if options.json:
        write_json(options.json, found)
    if options.out:
        draw(found, options.out)
    return found


def draw(found: dict[str, dict[str, dict[str, float]]], folder: Path) -> None:
    """Draw the normalized squared errors in their bands."""
    rows = {
        f"{name}: {quantity}": row
        for name, quantities in found.items()
        for quantity, row in quantities.items()
        if quantity != "fit"
    }
    figure = dots(
        {name: {"mean squared error / variance": row["nees"]} for name, row in rows.items()},
        "normalized squared error (grey: 95 % band)",
        limits={"consistent": 1.0},
        bands={name: (row["low"], row["high"]) for name, row in rows.items()},
    )
    theme.save(figure, folder, "consistency")


if __name__ == "__main__":
    sys.exit(bool(inconsistent(main())))
