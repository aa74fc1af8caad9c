"""What 20 touches find of a change of one module among 24, and how often they find one in vain.

24 modules on a sphere of 0.1 m, placed by hand to 0.3 mm a taxel; the earlier map is where they
should be. Touches are planned on the map (`ms.next_touches`) and pressed on the changed skin; the
change is then to be found by `ms.recalibrate` at a false-alarm rate of 1 % for the whole map. The
rows are the changes, the columns what the owner believes wrongly.

    python studies/recalibrate.py [--seeds 20] [--touches 20] [--out DIR]
"""

from __future__ import annotations

import argparse
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from dots import dots

import meshskin as ms
from meshskin.core import se3
from meshskin.estimation.recalibrate.skin_map import turns
from meshskin.report import theme
from meshskin.skin import slots
from meshskin.skin.skin import Modules

COUNT = 24
Named = tuple[str, int, str]
"""A change: "module" or "taxel", its number, its state."""
Changed = tuple[ms.Skin, set[Named]]
PLACING = 0.3e-3
"""Standard deviation of the taxels' places about the map, m."""


@dataclass(frozen=True)
class World:
    """The scene, the map, and the touches planned on it."""

    scene: ms.Scene
    modules: Modules
    points: np.ndarray


def world(touches: int = 20) -> World:
    """The scene of 24 modules with the readout of `sphere_noisy`."""
    scene = ms.Scene.load("sphere_noisy")
    modules = ms.Skin.modules(scene.body, count=COUNT, seed=1)
    scene = scene.with_(skin=modules.skin)
    return World(scene, modules, ms.next_touches(modules.skin, scene.belief(), touches).points)


def turned(skin: ms.Skin, module: int, rng: np.random.Generator, body: ms.Body) -> Changed:
    """The module's slots at the places of those a third of a turn on."""
    rows = np.flatnonzero(skin.ids // 12 == module)
    image = list(turns(slots.OFFSETS, np.array(slots.TAXELS)).values())[rng.integers(2)]
    place = dict(zip(skin.ids[rows] % 12, rows, strict=True))
    poses = skin.poses.copy()
    poses[rows] = skin.poses[[place[image[s]] for s in skin.ids[rows] % 12]]
    return replace(skin, poses=poses), {("module", module, "turned")}


def exchanged(skin: ms.Skin, module: int, rng: np.random.Generator, body: ms.Body) -> Changed:
    """Two modules plugged in for each other."""
    others = [m for m in np.unique(skin.ids // 12) if m != module]
    other = int(rng.choice(others))
    a, b = (np.flatnonzero(skin.ids // 12 == m) for m in (module, other))
    poses = skin.poses.copy()
    poses[a], poses[b] = skin.poses[b], skin.poses[a]
    return replace(skin, poses=poses), {
        ("module", module, "exchanged"), ("module", other, "exchanged"),
    }  # fmt: skip


def moved(skin: ms.Skin, module: int, rng: np.random.Generator, body: ms.Body) -> Changed:
    """The module 2 mm away, in any direction."""
    rows = np.flatnonzero(skin.ids // 12 == module)
    angle = rng.uniform(0, 2 * np.pi)
    step = skin.poses[rows[0], :3, :2] @ [np.cos(angle), np.sin(angle)]
    poses = skin.poses.copy()
    poses[rows, :3, 3] += 2e-3 * step
    return replace(skin, poses=poses).onto(body), {("module", module, "moved")}


def unchanged(skin: ms.Skin, module: int, rng: np.random.Generator, body: ms.Body) -> Changed:
    """Nothing."""
    return skin, set[Named]()


def on_readings(
    recording: ms.Recording, touched: np.ndarray, rng: np.random.Generator, factor: float
) -> tuple[ms.Recording, int]:
    """One touched taxel with its readings times a factor."""
    import pyarrow as pa

    taxel = int(rng.choice(touched))
    pressure = recording.pressure * np.where(recording.reading_taxel == taxel, factor, 1.0)
    readings = recording.with_columns(pressure=pressure).readings
    above = pa.array(pressure > recording.metadata["threshold_pa"])
    return replace(recording, readings=readings.filter(above)), taxel


CHANGES = {"nothing": unchanged, "turned": turned, "exchanged": exchanged, "moved 2 mm": moved}
GAINS = {"dead taxel": (0.0, "dead"), "gain x 2": (2.0, "gain changed")}
BELIEFS = ("right", "noise unknown", "E 20 % off", "touches 0.3 mm off")


def trial(
    setting: World, change: str, belief: str, seed: int
) -> tuple[set[Named], set[Named], ms.Recalibration]:
    """The changes made, those that were found, and the recalibration."""
    rng = np.random.default_rng(seed)
    scene, body = setting.scene, setting.scene.body
    skin = setting.modules.skin
    placed = skin.poses.copy()
    placed[:, :3, 3] += PLACING * np.einsum(
        "nij,nj->ni", skin.poses[:, :3, :2], rng.standard_normal((len(skin), 2))
    )
    skin = replace(skin, poses=placed).onto(body)
    made = CHANGES.get(change, unchanged)
    skin, truth = made(skin, int(rng.integers(COUNT)), rng, body)
    points = setting.points
    recording = ms.press(scene.with_(skin=skin), points, seed=seed)
    if change in GAINS:
        factor, state = GAINS[change]
        touched = np.unique(recording.reading_taxel[recording.pressure > 0.3 * scene.patch.peak])
        recording, taxel = on_readings(recording, touched, rng, factor)
        truth = {("taxel", taxel, state)}
    if belief == "touches 0.3 mm off":
        recording = displaced(recording, body, rng)
    known = scene.belief()
    if belief != "right":
        known = replace(known, noise_sigma=None)
    if belief == "E 20 % off":
        known = replace(known, material=replace(known.material, young=1.2 * known.material.young))
    result = ms.recalibrate(setting.modules.skin, recording, known, sigma=PLACING)
    return truth, {(f.unit, f.number, f.state) for f in result.findings}, result


def displaced(recording: ms.Recording, body: ms.Body, rng: np.random.Generator) -> ms.Recording:
    """The recording with contact points 0.3 mm off along each tangent."""
    basis = se3.orthonormal_basis(recording.normals)[:, :, :2]
    points = recording.points + np.einsum(
        "mij,mj->mi", basis, 0.3e-3 * rng.standard_normal((len(basis), 2))
    )
    return recording.with_columns(points=body.closest(points).point)


def _module(change: Named) -> int:
    """The module that a change is in."""
    return change[1] if change[0] == "module" else change[1] // slots.PER_MODULE


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--touches", type=int, default=20)
    parser.add_argument("--beliefs", nargs="*", default=BELIEFS)
    parser.add_argument("--changes", nargs="*", default=[*CHANGES, *GAINS])
    parser.add_argument("--verbose", action="store_true")
    parser.add_argument("--out", type=Path, default=None, help="folder of the figure")
    options = parser.parse_args()
    setting, rows = world(options.touches), dict[str, dict[str, float]]()
    print(
        f"{'change':12} {'belief':20} {'found':>8} {'in part':>8} {'misnamed':>8} {'alarms':>8}"
        " confirmed undecided not touched"
    )
    for change in options.changes:
        for belief in options.beliefs:
            found = part = other = alarms = 0
            states: Counter = Counter()
            for seed in range(options.seeds):
                truth, named, result = trial(setting, change, belief, seed)
                found += truth <= named
                part += bool(truth & named) and not truth <= named
                changed = {_module(one) for one in truth}
                alarms += any(_module(one) not in changed for one in named)
                other += bool(named - truth) and not truth & named
                states.update(result.unit_states.tolist())
                if options.verbose and named != truth:
                    print(seed, "truth", truth)
                    print("   ", "\n    ".join(map(str, result.findings)), result.lines()[1])
            counts = {"found": found, "found in part": part, "false alarms": alarms}
            rows[f"{change}, {belief}"] = {k: n / options.seeds for k, n in counts.items()}
            share = [states[s] / options.seeds for s in ("confirmed", "undecided", "not touched")]
            print(
                f"{change:12} {belief:20} "
                + " ".join(f"{x:>3}/{options.seeds:<4}" for x in (found, part, other, alarms))
                + " ".join(f"{x:9.1f}" for x in share),
                flush=True,
            )
    if options.out:
        theme.save(dots(rows, "share of the seeds"), options.out, "recalibrate")


if __name__ == "__main__":
    main()
