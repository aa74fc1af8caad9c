"""Seconds of the whole job on the paper's sphere, and the rate of the closed loop.

    python studies/speed/sphere.py [--runs 5] [--out DIR]

Runs `meshskin run sphere` and `import meshskin` several times in new processes, and prints the
median and the best, the processor time, and the steps per second of the closed loop with the
dynamics of the arm. A run before them, which is not counted, compiles kernels and bytecode, as an
installation has it. Exits with 1 if a value misses its limit: 10 s per run, 0.6 s per import,
30,000 steps/s.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from time import perf_counter

import results

LIMITS = {"run_s": 10.0, "import_s": 0.6, "steps_per_second": 30_000.0}


def timed(bytecode: str, *command: str) -> tuple[float, float]:
    """Seconds of a command in a new process, and its processor time; bytecode: a folder for it."""
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    environment["PYTHONPYCACHEPREFIX"] = bytecode
    start, before = perf_counter(), os.times()
    line = [sys.executable, *command]
    subprocess.run(line, check=True, stdout=subprocess.DEVNULL, env=environment)
    after = os.times()
    used = after.children_user + after.children_system
    return perf_counter() - start, used - before.children_user - before.children_system


def main() -> int:
    """Measure, print, compare with the limits."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--scene", default="sphere")
    results.add_out(parser)
    options = parser.parse_args()
    runs, cpu, rates, stages = [], [], [], []
    with tempfile.TemporaryDirectory() as folder, tempfile.TemporaryDirectory() as code:
        run = ("-m", "meshskin", "run", options.scene, "--out", folder, "--quiet")
        timed(code, *run)
        for _ in range(options.runs):
            seconds, used = timed(code, *run)
            runs.append(seconds)
            cpu.append(used)
            metrics = json.loads((Path(folder) / "metrics.json").read_text())
            rates.append(metrics["steps_per_second"])
            stages.append(metrics["seconds"])
        bare = statistics.median(timed(code, "-c", "pass")[0] for _ in range(options.runs))
        imports = [timed(code, "-c", "import meshskin")[0] - bare for _ in range(options.runs)]
    found = {
        "run_s": statistics.median(runs),
        "import_s": statistics.median(imports),
        "steps_per_second": statistics.median(rates),
    }
    print(
        f"meshskin run {options.scene}: median {found['run_s']:.2f} s, best {min(runs):.2f} s, "
        f"processor time {statistics.median(cpu):.2f} s"
    )
    for stage in stages[0]:
        print(f"  {stage:10} {statistics.median(s[stage] for s in stages):6.2f} s")
    print(f"import meshskin: median {found['import_s']:.3f} s")
    print(f"closed loop with arm: {found['steps_per_second']:,.0f} steps/s, best {max(rates):,.0f}")
    rows = {stage: {"median": statistics.median(s[stage] for s in stages)} for stage in stages[0]}
    results.write(options.out, "sphere", found, rows, f"seconds of meshskin run {options.scene}")
    short = [
        name
        for name, limit in LIMITS.items()
        if (found[name] < limit if name.endswith("second") else found[name] > limit)
    ]
    print("falls short: " + ", ".join(short) if short else "all within their limits")
    return 1 if short else 0


if __name__ == "__main__":
    sys.exit(main())
