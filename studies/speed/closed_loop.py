"""Steps per second of the closed loop with 80 taxels read at every step, compared with MuJoCo.

    OMP_NUM_THREADS=1 python studies/speed/closed_loop.py [--repeats 7] [--out DIR]

Explores the paper's sphere (5,120 faces) and two fine bodies (over 200,000 faces) with and without
the arm, interpreted and compiled, and a batch of 1,000 episodes. MuJoCo (`pip install mujoco`) gets
the same arm, the sphere as a primitive, the indenter and 80 touch sensors: stepping alone in C, and
with the compliance law in NumPy. Every rate is the best of several rounds over all cases, in
processor time of all threads, so that other work on the machine has little influence. The last line
gives the ratios of reached to required rates; the exit code is 1 if one is below 1.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import replace
from time import process_time

import numpy as np
import results
from batch_simulator import BatchSimulator
from point_readings import PointReadings

import meshskin as ms
from meshskin.geometry.region import Cap
from meshskin.simulation.simulate import prepare, run
from meshskin.simulation.track import Track

DEMANDED = {
    "arm, interpreted": 50e3,
    "arm, compiled": 500e3,
    "quasi-static, interpreted": 150e3,
    "quasi-static, compiled": 600e3,
    "batched": 2e6,
}
PARITY = 0.85
"""Smallest rate on a fine body, relative to the sphere's."""
OVER_LAW, OVER_BARE = 1.5, 2.0
"""Interpreted over MuJoCo with the law in NumPy; compiled over MuJoCo's bare stepping."""
EPISODES, BATCH_STEPS = 1000, 200


def scenes() -> dict[str, ms.Scene]:
    """The sphere, and the same skin's scene on fine bodies."""
    sphere = ms.Scene.load("sphere")
    fine = {
        "fine sphere": ms.Body.sphere(0.1, faces=200_000),
        "fine ellipsoid": ms.Body.ellipsoid((0.11, 0.1, 0.09), faces=200_000),
    }
    made = {"sphere": sphere}
    for name, body in fine.items():
        skin = ms.Skin.cover(body, count=80, spacing=5e-3, region=cap())
        made[name] = sphere.with_(body=body, skin=skin, name=name)
    return made


def cap() -> Cap:
    """The bottom of the body."""
    return Cap(direction=(0.0, 0.0, -1.0))


def loop_case(scene: ms.Scene, mode: str, compile_: str) -> Callable[[], float]:
    """Steps a second of the closed loop over the scene's exploration, all taxels read."""
    scene = scene.with_(loop=replace(scene.loop, mode=mode, compile=compile_))
    simulator, path = prepare(scene)
    read = PointReadings(simulator.loop, scene.skin.positions, compiled=compile_ == "always")

    def rate() -> float:
        simulator.reset()
        started = process_time()
        for steps in run(scene, simulator, path):
            assert read(steps.outputs).shape == (len(steps.time), len(scene.skin.ids))
        return simulator.steps / (process_time() - started)

    return rate


def batch_case(scene: ms.Scene) -> Callable[[], float]:
    """Steps a second of all episodes of a batch along the path, without an arm."""
    scene = scene.with_(loop=replace(scene.loop, mode="quasi_static"))
    simulator, path = prepare(scene)
    track = Track.of(path, scene.body.surface)
    rows = np.linspace(0, len(track) - BATCH_STEPS, EPISODES).astype(np.intp)

    def rate() -> float:
        batch = BatchSimulator(
            scene.body, simulator.loop, track, rows, compile_="always", taxels=scene.skin.positions
        )
        started = process_time()
        for _ in range(BATCH_STEPS):
            batch.advance()
        seconds = process_time() - started
        assert batch.readings is not None
        assert batch.readings.max() > 0
        return EPISODES * BATCH_STEPS / seconds

    return rate


def main() -> int:
    """Measure, print, compare with what is demanded."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--repeats", type=int, default=7)
    results.add_out(parser)
    options = parser.parse_args()
    rates = measure(options.repeats)
    for name, value in rates.items():
        print(f"{name:45s} {value:12,.0f} steps/s")
    table = ratios(rates)
    rows: dict[str, dict[str, float]] = {}
    for name, value in rates.items():
        case, _, body = name.rpartition(", ")
        rows.setdefault(case, {})[body] = value
    numbers = {"rates": rates, "ratios": table}
    results.write(options.out, "closed_loop", numbers, rows, "steps per second")
    print(" | ".join(f"{name} {value:.2f}" for name, value in table.items()))
    return 0 if min(table.values()) >= 1.0 else 1


def measure(repeats: int) -> dict[str, float]:
    """Steps a second by case: the best of some rounds over all cases."""
    made = cases()
    rates = dict.fromkeys(made, 0.0)
    for _ in range(repeats):
        for name, case in made.items():
            rates[name] = max(rates[name], case())
    return rates


def cases() -> dict[str, Callable[[], float]]:
    """What is measured, by name."""
    made, bodies = {}, scenes()
    for mode in ("arm", "quasi_static"):
        for compile_, word in (("never", "interpreted"), ("always", "compiled")):
            for name, scene in bodies.items():
                key = f"{mode.replace('_', '-')}, {word}, {name}"
                made[key] = loop_case(scene, mode, compile_)
    made["batched, sphere"] = batch_case(bodies["sphere"])
    try:
        from mujoco_sphere import Peer
    except ImportError as error:
        print(f"without MuJoCo ({error}): pip install mujoco")
        return made
    peer = Peer(bodies["sphere"])
    made["MuJoCo, bare"] = lambda: peer.bare(20_000)
    made["MuJoCo, law in NumPy"] = lambda: peer.with_law(3_000)
    return made


def ratios(rates: dict[str, float]) -> dict[str, float]:
    """Reached over demanded."""
    table = {name: rates[f"{name}, sphere"] / least for name, least in DEMANDED.items()}
    for name in DEMANDED:
        ours = rates[f"{name}, sphere"]
        fine = [rates[k] for k in rates if k.startswith(f"{name}, fine")]
        if fine:
            table[f"{name}: fine bodies"] = min(fine) / ours / PARITY
    if "MuJoCo, bare" in rates:
        law, bare = rates["MuJoCo, law in NumPy"], rates["MuJoCo, bare"]
        table["over MuJoCo with law"] = rates["arm, interpreted, sphere"] / law / OVER_LAW
        table["compiled over bare MuJoCo"] = rates["arm, compiled, sphere"] / bare / OVER_BARE
    return table


if __name__ == "__main__":
    sys.exit(main())
