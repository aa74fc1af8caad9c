"""Skins of a real NAO calibrated from where they touch each other, beside published figures.

    python studies/self_touch.py --out figures/ [--data DIR] [--splits 10] [--pairs leftArm_torso]

DIR (by default MESHSKIN_DATA) holds nao_selftouch. Each of the splits takes 70 % of the touches to
fit, and the others to test; stated are root mean square distances of the two contacts, mm, mean and
standard deviation over the splits. Published, on one split with mounts free alone: leftArm_torso
22.34 before, 14.25 train, 15.73 test; leftArm_head 26.16, 20.54, 17.58.

A contact is one of three things: the recording's selected centre of pressure of each skin; the
nearest pair of the centres of the two skins with the nominal mounts, as the authors' code takes
them (multirobot-calibration, Robots/Nao/findClosestCop.m); or the mean of all taxels that answer,
which selects nothing. Before a fit the selected centres are 37.4 mm apart on leftArm_head and 32.5
on leftArm_torso, the nearest pairs 25.9 and 18.2: the published 26.16 is that of the nearest pairs,
and neither rule gives the published 22.34. Fitted, the nearest pairs are nearer than published on
both. 70 % of the touches of leftArm_head have several centres on each skin, and those selected are
not the nearest ones with these mounts.
"size" is the root mean square radius of each skin over its nominal one: a skin that shrinks brings
contacts together whatever the truth. "contradicted" counts priors that the touches contradict.
"""

from __future__ import annotations

import argparse
import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from dots import dots

import meshskin as ms
from meshskin.core.se3 import transform
from meshskin.report import theme
from meshskin.robot.chain import Chain

if TYPE_CHECKING:
    from matplotlib.figure import Figure

HALF = np.pi / 2
ARM = [
    (0, 0.1, -HALF, 0),
    (0, 0.098, HALF, 0),
    (0, 0, HALF, HALF),
    (0.015, 0.105, -HALF, 0),
    (0, 0, HALF, 0),
    (0, 0.05595, -HALF, np.pi),
]
HEAD = [(0, 0.1265, 0, 0), (0, 0, -HALF, 0), (0, 0, 0, 0)]
JOINTS = {
    "leftArm": ("LShoulderPitch", "LShoulderRoll", "LElbowYaw", "LElbowRoll", "LWristYaw"),
    "head": ("HeadYaw", "HeadPitch"),
}
SKIN_AXES = {
    "leftArm": np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]),
    "head": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
}
"""Axes of the skins' coordinates, which are the robot's, in the last frames of the chains."""
SECOND_PATCH = {
    "leftArm": (19, 22, 23, 25, 26, 20, 21, 31),
    "torso": (16, 17, 18, 24, 25, 26, 27, 28, 29, 30, 31),
    "head": (16, 17, 18, 19, 20, 21, 22, 23, 24, 28, 29, 31),
}
"""Triangles of the second of each skin's two patches."""
PUBLISHED = {"leftArm_torso": (22.34, 14.25, 15.73), "leftArm_head": (26.16, 20.54, 17.58)}
PATCHES = {"patch_sigma": 7e-3, "patch_turn_sigma": np.deg2rad(9)}
"""The source's bounds of patches, as sigmas."""
SELECTED, NEAREST, ALL = "selected centres", "nearest centres", "all taxels"
CASES: list[tuple[str, str, dict[str, float]]] = [
    (SELECTED, "mounts", {}),
    (NEAREST, "mounts", {}),
    (ALL, "mounts", {}),
    (ALL, "mounts, patches", PATCHES),
    (ALL, "mounts, patches, taxels 2 mm", PATCHES | {"taxel_sigma": 2e-3}),
    (ALL, "mounts, patches, joints 2 deg", PATCHES | {"joint_sigma": np.deg2rad(2)}),
]
Sides = tuple[ms.TouchSide, ms.TouchSide]


def chain_of(name: str) -> Chain | None:
    """The chain of a skin; None for the torso."""
    if name not in JOINTS:
        return None
    chain = Chain.from_dh(ARM if name == "leftArm" else HEAD, fixed=(0,))
    return chain.with_tip(transform(SKIN_AXES[name], np.zeros(3)))


def load(folder: Path, pair: str, contact: str) -> Sides:
    """The touches of a pair of skins, with contacts of one kind."""
    from scipy.io import loadmat

    record = loadmat(folder / f"{pair}.mat", squeeze_me=True, struct_as_record=False)
    names = pair.split("_")
    first, second = (_side(record[name], name, contact) for name in names)
    if contact == NEAREST:
        centres = _nearest([record[name] for name in names], [first, second])
        return replace(first, positions=centres[0]), replace(second, positions=centres[1])
    return first, second


def _nearest(events: list[Any], sides: list[ms.TouchSide]) -> tuple[np.ndarray, np.ndarray]:
    """The centres (n, 3), m, of each skin that are nearest to one of the other's, of each touch,
    with nominal mounts."""
    chosen = []
    poses = [
        np.tile(np.eye(4), (len(e), 1, 1)) if s.chain is None else s.chain.poses(s.angles)
        for e, s in zip(events, sides, strict=True)
    ]
    for here, there, *both in zip(*poses, *events, strict=True):
        centres = [np.atleast_2d(event.copsUn) for event in both]
        first, second = (
            c @ T[:3, :3].T + T[:3, 3] for c, T in zip(centres, (here, there), strict=True)
        )
        apart = np.linalg.norm(first[:, None] - second, axis=2)
        i, j = np.unravel_index(np.argmin(apart), apart.shape)
        chosen.append((centres[0][i], centres[1][j]))
    return np.array([a for a, _ in chosen]), np.array([b for _, b in chosen])


def _side(events: Any, name: str, contact: str) -> ms.TouchSide:
    joints = JOINTS.get(name, ())
    angles = np.array([[getattr(e.angles, joint) for joint in joints] for e in events])
    given: dict[str, Any] = {"chain": chain_of(name), "angles": angles.reshape(len(events), -1)}
    if contact != ALL:  # a taxel for each touch
        centres = np.array([e.copNoT for e in events])
        return ms.TouchSide(positions=centres, readings=np.eye(len(events)), **given)
    active = [np.atleast_2d(e.activatedUn) for e in events]
    rows = np.concatenate(active)
    ids, where = np.unique(rows[:, 3].astype(int), return_index=True)
    readings = np.zeros((len(events), len(ids)))
    for k, taxels in enumerate(active):
        readings[k, np.searchsorted(ids, taxels[:, 3].astype(int))] = 1.0
    patch = np.isin(ids // 12, SECOND_PATCH[name]).astype(int)
    return ms.TouchSide(positions=rows[where, :3], readings=readings, patch=patch, **given)


def splits(
    first: ms.TouchSide, second: ms.TouchSide, free: dict[str, Any], count: int
) -> tuple[list[float], list[float], list[ms.SelfTouch]]:
    """Root mean square distances, mm, of `count` random splits: train and test, and the fits."""
    sides = replace(first, **free), replace(second, **free)
    train, test, fits = [], [], []
    for seed in range(count):
        order = np.random.default_rng(seed).permutation(len(first.readings))
        cut = int(0.7 * len(order))
        used, held = ([side.of(rows) for side in sides] for rows in (order[:cut], order[cut:]))
        fits.append(ms.self_touch(*used))
        train.append(_rms(fits[-1].distances(*used)))
        test.append(_rms(fits[-1].distances(*held)))
    return train, test, fits


def _rms(distances: np.ndarray) -> float:
    return 1e3 * float(np.sqrt(np.mean(distances**2)))


def before(first: ms.TouchSide, second: ms.TouchSide) -> float:
    """Root mean square distance, mm, with nominal mounts."""
    from meshskin.estimation.self_touch.side import SideState, contacts

    here, there = (contacts(side, SideState.nominal(side))[0] for side in (first, second))
    return _rms(np.linalg.norm(here - there, axis=1))


def size(side: ms.TouchSide, positions: np.ndarray) -> float:
    """Root mean square radius of a skin over its nominal one."""
    spread = [np.sum(np.var(x, axis=0)) for x in (positions, side.positions)]
    return float(np.sqrt(spread[0] / spread[1]))


def of_pair(folder: Path, pair: str, count: int) -> list[dict[str, Any]]:
    """The rows of the table of a pair of skins."""
    found = []
    for contact, case, free in CASES:
        sides = load(folder, pair, contact)
        train, test, fits = splits(*sides, free, count)
        sizes = np.mean(
            [[size(s, p) for s, p in zip(sides, f.positions, strict=True)] for f in fits], axis=0
        )
        row = {
            "contact": contact, "free": case, "before": before(*sides),
            "train": np.mean(train), "train_sd": np.std(train),
            "test": np.mean(test), "test_sd": np.std(test),
            "size": tuple(sizes), "contradicted": np.mean([len(f.contradicted) for f in fits]),
            "tests": test,
        }  # fmt: skip
        found.append(row)
        print(
            f"{contact:18}{case:32}{row['before']:8.2f}{row['train']:8.2f} ({row['train_sd']:.2f})"
            f"{row['test']:8.2f} ({row['test_sd']:.2f})   {sizes[0]:.2f} {sizes[1]:.2f}"
            f"{row['contradicted']:8.1f}",
            flush=True,
        )
    return found


def draw(found: dict[str, list[dict[str, Any]]]) -> Figure:
    """Test distances: mean and span of the splits, beside the published ones."""
    rows: dict[str, dict[str, float | None]] = {}
    spans = {}
    for pair, table in found.items():
        for row in table:
            name = f"{pair.replace('_', ', ')}, {row['contact']}: {row['free']}"
            rows[name] = {"mean of the splits": row["test"]}
            spans[name] = min(row["tests"]), max(row["tests"])
            if (row["contact"], row["free"]) == CASES[0][:2] and pair in PUBLISHED:
                rows[name]["published"] = PUBLISHED[pair][2]
    return dots(rows, "test distance (mm)", bands=spans)


def main(arguments: list[str] | None = None) -> dict[str, list[dict[str, Any]]]:
    """Run the study and return its tables."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, help="folder of the figure")
    parser.add_argument("--data", type=Path, default=os.environ.get("MESHSKIN_DATA", "data"))
    parser.add_argument("--splits", type=int, default=10)
    parser.add_argument("--pairs", nargs="+", default=list(PUBLISHED))
    options = parser.parse_args(arguments)
    folder = options.data / "nao_selftouch"
    if not folder.is_dir():
        print(f"no touches of NAO: {folder} is not there")
        return {}
    found = {}
    for pair in options.pairs:
        published = PUBLISHED.get(pair)
        print(f"\n{pair} (mm){'':33}  before     train (sd)      test (sd)   size   contradicted")
        if published:
            print(f"{'published':18}{'mounts':32}{published[0]:8.2f}{published[1]:8.2f}"
                  f"{published[2]:15.2f}")  # fmt: skip
        found[pair] = of_pair(folder, pair, options.splits)
    if options.out:
        theme.save(draw(found), options.out, "self_touch")
    return found


if __name__ == "__main__":
    main()
