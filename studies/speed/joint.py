"""The joint estimate as a function of the size of the skin: seconds and peak memory.

    python studies/speed/joint.py [--sizes 80 1000 10000] [--large] [--contact MODEL] [--learned]
        [--out DIR]

Taxels lie at random distances of about 5 mm on a sphere that grows with their number, so that the
contact is the same at every size; 50 readings per taxel at 80 taxels, 40 above. Every size runs in
its own process, on one thread. "build" is everything before the optimization: gathering the
recording, trilateration, selection of readings; "solve" is the rest. Exits with 1 if a size exceeds
its limit in processor seconds. --large: 100,000 taxels with 4 million readings, too. --contact:
hertz, elliptic (circles on a sphere, at the cost of ellipses) or layered (a layer of 6 mm).
--learned: every size with a learned response, too, in a process of its own; its processor time and
peak memory are printed relative to those of the contact model's estimate, and have limits.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from dataclasses import replace
from time import perf_counter, process_time
from typing import TYPE_CHECKING, Any

import numpy as np
import results

from meshskin.contact.problem import effective_modulus

if TYPE_CHECKING:
    from meshskin.estimation.data.measurements import Measurements
    from meshskin.estimation.result import EstimatorResult
    from meshskin.recording.recording import Recording
    from meshskin.scene.belief import Belief

LIMITS = {80: (0.2, 2.0), 10_000: (15.0, 2.0), 100_000: (240.0, 16.0)}
"""Seconds (build and solve) and GB at each size."""
LEARNED_LIMITS = 3.0, 2.0
"""Processor time and peak memory of a learned response, relative to the contact model's."""
YOUNG, POISSON, INDENTER, DISC, FORCE, SPACING = 0.2e6, 0.49, 0.01, 2e-3, 3.0, 5e-3
NOISE, THRESHOLD = 0.01, 0.05
LAYER = 6e-3
"""Thickness under `--contact layered`, m."""


def world(
    taxels: int, seed: int = 0, contact: str = "hertz"
) -> tuple[Recording, Belief, np.ndarray]:
    """A recording of a skin of so many taxels, its belief, and the true positions (n, 3), m."""
    import pyarrow as pa
    from scipy.spatial import cKDTree

    from meshskin.contact import ContactModel
    from meshskin.contact.indenter import Indenter
    from meshskin.contact.material import Material
    from meshskin.contact.reading import ReadingModel
    from meshskin.geometry.body import Body
    from meshskin.recording.recording import CONTACT_SCHEMA, READING_SCHEMA, Recording
    from meshskin.scene.belief import Belief

    rng = np.random.default_rng(seed)
    radius = max(0.1, SPACING * np.sqrt(taxels / np.pi))
    body = Body.sphere(radius)
    truth = _spiral(taxels, radius)
    contacts = _spiral(round(taxels * (14.5 if taxels <= 80 else 11.2)), radius, taxels)
    contacts = body.closest(contacts + rng.normal(scale=0.5e-3, size=contacts.shape)).point
    hit = body.closest(contacts)
    force = FORCE * (1 + 0.01 * rng.normal(size=len(contacts)))
    modulus = effective_modulus(YOUNG, POISSON)
    model = ContactModel(contact, POISSON, LAYER if contact == "layered" else None)
    patches = model.patches(
        force=force, curvature=hit.curvature, indenter_radius=INDENTER, effective_modulus=modulus
    )
    peak = float(np.median(patches.peak))
    tree, pairs = cKDTree(truth), []
    for begin in range(0, len(contacts), 500):
        rows = slice(begin, begin + 500)
        near = np.unique(np.concatenate(tree.query_ball_point(contacts[rows], 0.01)).astype(int))
        p = ReadingModel(model, DISC, INDENTER, modulus).pressures(
            hit.point[rows], hit.normal[rows], hit.direction[rows], force[rows],
            hit.curvature[rows], truth[near],
        )  # fmt: skip
        row, column = np.nonzero(p)
        value = p[row, column] + NOISE * peak * rng.normal(size=len(row))
        heard = value > THRESHOLD * peak
        pairs.append((begin + row[heard], near[column[heard]], value[heard]))
    press, taxel, value = (np.concatenate(part) for part in zip(*pairs, strict=True))
    time = 0.01 * np.arange(len(contacts))
    recording = Recording(
        pa.table([time, *hit.point.T, *hit.normal.T, force], schema=CONTACT_SCHEMA),
        pa.table([time[press], taxel.astype(np.int32), value], schema=READING_SCHEMA),
        {"taxel_ids": list(range(taxels)), "disc_radius_m": DISC},
    )
    belief = Belief(
        body=body, indenter=Indenter(INDENTER), material=Material(YOUNG, POISSON, model.thickness),
        contact=model.name, taxel_ids=np.arange(taxels), disc_radius=DISC, force_reference=FORCE,
        noise_sigma=NOISE * peak, threshold=THRESHOLD * peak,
    )  # fmt: skip
    return recording, belief, truth


def _spiral(n: int, radius: float, taxels: int | None = None) -> np.ndarray:
    """n points, evenly over the cap of `taxels` (n by default) at the bottom of a sphere."""
    k = np.arange(n) + 0.5
    height = 1 - (taxels or n) * SPACING**2 / (2 * np.pi * radius**2) * k / n
    angle = np.pi * (3 - np.sqrt(5)) * k
    ring = np.sqrt(1 - height**2)
    return radius * np.column_stack([ring * np.cos(angle), ring * np.sin(angle), -height])


def measure(taxels: int, contact: str = "hertz", learned: bool = False) -> dict[str, float]:
    """Numbers of one size, in this process; learned: with a learned response."""
    import resource

    from meshskin.estimation.data.gather import gather
    from meshskin.estimation.joint import maximum_likelihood
    from meshskin.estimation.learned import estimate as learned_estimate
    from meshskin.estimation.trilateration import trilaterate

    def estimate(data: Measurements, start: EstimatorResult | None = None) -> EstimatorResult:
        if learned:
            return learned_estimate.estimate(data)
        return maximum_likelihood.optimum(data, start).result()

    believed = "learned" if learned else contact
    if taxels <= 1000:  # the small sizes as in a running program: kernel loaded, libraries imported
        small, belief, _ = world(60, seed=1, contact=contact)
        estimate(gather(small, replace(belief, contact=believed)))
    recording, belief, truth = world(taxels, contact=contact)
    belief = replace(belief, contact=believed)
    clock, cpu = perf_counter(), process_time()
    data = gather(recording, belief)
    start = None if learned else trilaterate.least_squares(data)  # part of a learned estimate
    started = perf_counter() - clock
    found = estimate(data, start)
    cpu, total = process_time() - cpu, perf_counter() - clock
    build = started + found.seconds.get("readings", 0.0)
    error = np.linalg.norm(found.points - truth, axis=1)
    return {
        "taxels": taxels,
        "readings": len(data.pressure),
        "build_s": build,
        "solve_s": total - build,
        "total_s": total,
        "cpu_s": cpu,
        "gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
        "lost": int(np.isnan(error).sum()),
        "error_mm": 1e3 * float(np.nanmean(error)),
    }


def main() -> int:
    """Measure every size, print, compare with the limits."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", type=int, nargs="+", default=[80, 1000, 10_000])
    parser.add_argument("--large", action="store_true")
    parser.add_argument("--one", type=int, default=None, help=argparse.SUPPRESS)
    parser.add_argument("--contact", choices=["hertz", "elliptic", "layered"], default="hertz")
    parser.add_argument("--learned", action="store_true", help="a learned response, too")
    results.add_out(parser)
    options = parser.parse_args()
    if options.one:
        print(json.dumps(measure(options.one, options.contact, options.learned)))
        return 0
    print("   taxels   readings   build s   solve s   total s     cpu s    GB  error mm  lost")
    rows, short = [], []
    for size in options.sizes + [100_000] * options.large:
        row = in_own_process(size, options.contact)
        rows.append(row)
        print(line(row), flush=True)
        seconds, memory = LIMITS.get(size, (np.inf, np.inf))
        if row["cpu_s"] > seconds or row["gb"] > memory:
            short.append(f"{size:,} taxels: limits are {seconds} s and {memory} GB")
        if options.learned:
            row["learned"] = other = in_own_process(size, options.contact, "--learned")
            ratios = other["cpu_s"] / row["cpu_s"], other["gb"] / row["gb"]
            print(f"{line(other)}  learned: {ratios[0]:.2f} times the processor time, "
                  f"{ratios[1]:.2f} times the memory", flush=True)  # fmt: skip
            if any(np.array(ratios) > LEARNED_LIMITS):
                short.append(f"{size:,} taxels, learned: limits are {LEARNED_LIMITS} times")
    shown = {f"{row['taxels']:,} taxels": {"contact model": row["cpu_s"]} for row in rows}
    for row in (row for row in rows if "learned" in row):
        shown[f"{row['taxels']:,} taxels"]["learned response"] = row["learned"]["cpu_s"]
    results.write(options.out, "joint", rows, shown, "processor time (s)")
    print(*short, sep="\n")
    return 1 if short else 0


def in_own_process(taxels: int, contact: str, *options: str) -> dict[str, Any]:
    """`measure` in a process of its own."""
    command = [sys.executable, __file__, "--one", str(taxels), "--contact", contact, *options]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    out = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    found: dict[str, Any] = json.loads(out.stdout)
    return found


def line(row: dict[str, Any]) -> str:
    """A row of the table."""
    return (f"{row['taxels']:9,} {row['readings']:10,} {row['build_s']:9.3f} "
            f"{row['solve_s']:9.3f} {row['total_s']:9.3f} {row['cpu_s']:9.3f} {row['gb']:5.2f} "
            f"{row['error_mm']:9.4f} {row['lost']:5}")  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
