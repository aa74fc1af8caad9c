"""Overhead of a study: per case, use of the cores, expansion of the grid, and resuming.

    python studies/speed/study.py [--cases 100000] [--out DIR]

Overhead: the time of trivial cases, times the number of workers. Use: the part of the workers' time
inside cases of half a second, including the start of the workers. Resume: a sweep whose cases are
all done, in its own process (its peak memory is printed), with result files of realistic size.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import results

import meshskin as ms
from meshskin.study.sweep.case import Case, Outcome
from meshskin.study.sweep.store import Store
from meshskin.study.sweep.study import Progress, cores

NAMES = [f"result_{k}" for k in range(17)]


def trivial(case: Case) -> dict[str, float]:
    """As many numbers as the default run function returns, at once."""
    return values(case.seed)


def half_a_second(case: Case) -> dict[str, float]:
    """Half a second of work."""
    end, total = time.perf_counter() + 0.5, 0.0
    while time.perf_counter() < end:
        total += 1.0
    return values(case.seed)


def values(seed: int) -> dict[str, float]:
    """Numbers of a full width of digits."""
    return {name: (seed + 1) / (k + 3) for k, name in enumerate(NAMES)}


def many(cases: int) -> ms.Study:
    """A study of a scene with about that many cases."""
    grid: dict[str, Sequence[float]] = {
        "material.young_kpa": [100 + 10 * k for k in range(20)],
        "effects.gaussian_noise.sigma_relative": [0.001 * (k + 1) for k in range(20)],
        "skin.spacing_mm": [4, 4.5, 5, 5.5, 6],
    }
    return ms.Study("many", base="sphere_noisy", grid=grid, seeds=max(cases // 2000, 1))


def overhead(folder: Path, workers: int, count: int = 2000) -> float:
    """Seconds that a case costs beside its own work, from the first result to the last."""
    times: list[float] = []

    def note(state: Progress) -> None:
        times.append(time.perf_counter())

    study = ms.Study("trivial", seeds=count, run=trivial)
    study.sweep(folder / f"overhead{workers}", workers=workers, progress=note)
    return workers * (times[-1] - times[workers]) / (len(times) - 1 - workers)


def use(folder: Path, workers: int, each: int = 24) -> tuple[float, float]:
    """Part of the workers' time inside cases: of the whole sweep, and once they have started."""
    times: list[float] = []

    def note(state: Progress) -> None:
        times.append(time.perf_counter())

    study = ms.Study("use", seeds=each * workers, run=half_a_second)
    begin = time.perf_counter()
    study.sweep(folder / "use", workers=workers, progress=note)
    wall = time.perf_counter() - begin
    import pyarrow.parquet as pq

    table = pq.read_table(folder / "use" / "times.parquet")
    inside = sum(table.column("seconds").to_pylist())
    started = (len(times) - 1 - workers) * inside / (len(times) - 1)
    return inside / (workers * wall), started / (workers * (times[-1] - times[workers]))


def expand_and_resume(folder: Path, cases: int) -> dict[str, float]:
    """Seconds and peak memory of both, each in a fresh process."""
    out = folder / "many"
    begin = time.perf_counter()
    store = Store(out)
    for case in many(cases).cases():
        store.write(Outcome(case.key, values(case.seed), seconds=1.0))
    written = time.perf_counter() - begin
    numbers = {"write_s": written}
    for step in ("expand", "resume"):
        command = [sys.executable, __file__, "--step", step, "--cases", str(cases)]
        run = subprocess.run(
            [*command, "--folder", str(out)], check=True, capture_output=True, text=True
        )
        numbers |= json.loads(run.stdout)
    return numbers


def step(name: str, cases: int, out: Path) -> dict[str, float]:
    """One step, in this process."""
    import resource

    begin, study = time.perf_counter(), many(cases)
    count = len(study.cases()) if name == "expand" else study.sweep(out).num_rows
    return {
        f"{name}_s": time.perf_counter() - begin,
        f"{name}_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3,
        "cases": count,
    }


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    """Run the study; return its numbers."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=100_000)
    results.add_out(parser)
    parser.add_argument("--step", choices=("expand", "resume"), help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.step:
        numbers: Mapping[str, float] = step(options.step, options.cases, options.folder)
        print(json.dumps(numbers))
        return dict(numbers)
    with tempfile.TemporaryDirectory() as folder:
        found = measure(Path(folder), options.cases)
    rows = {
        name.removesuffix("_ms").replace("_", ", workers: "): {"measured": value}
        for name, value in found.items()
        if name.endswith("_ms")
    }
    for name in ("write", "expand", "resume"):
        rows[name] = {"measured": 1e3 * found[f"{name}_s"] / options.cases}
    results.write(options.out, "study", found, rows, "ms per case")
    return found


def measure(folder: Path, cases: int) -> dict[str, Any]:
    """All numbers, printed as they come."""
    workers = cores()
    found: dict[str, Any] = {"workers": workers, "load": os.getloadavg()[0]}
    print(f"{workers} cores, load before the start {found['load']:.1f}")
    for count in sorted({1, workers}):
        found[f"overhead_{count}_ms"] = 1e3 * overhead(folder, count)
        print(f"overhead, {count} workers   {found[f'overhead_{count}_ms']:8.2f} ms a case")
    found["use"], found["use_started"] = use(folder, workers)
    print(f"use of {workers} cores       {100 * found['use']:8.1f} %   (0.5 s a case; "
          f"{100 * found['use_started']:.1f} % once started)")  # fmt: skip
    found |= expand_and_resume(folder, cases)
    print(f"{found['cases']:,} cases")
    for name in ("expand", "resume"):
        print(f"  {name}             {found[f'{name}_s']:8.1f} s {found[f'{name}_mb']:8.0f} MB")
    return found


if __name__ == "__main__":
    main()
