"""Seconds of the whole job on the paper's sphere, and the rate of the closed loop.

    python studies/speed/sphere.py [--runs 5] [--out DIR]

Runs `meshskin run sphere` and `import meshskin` several times in new processes, and prints the
median and the best, and the steps per second of the closed loop with the dynamics of the arm. Exits
with 1 if a value misses its limit: 10 s per run, 0.6 s per import, 30,000 steps/s.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from time import perf_counter

import results

LIMITS = {"run_s": 10.0, "import_s": 0.6, "steps_per_second": 30_000.0}


def timed(*command: str) -> float:
    """Seconds of a command in a new process."""
    start = perf_counter()
    subprocess.run([sys.executable, *command], check=True, stdout=subprocess.DEVNULL)
    return perf_counter() - start


def main() -> int:
    """Measure, print, compare with the limits."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--scene", default="sphere")
    results.add_out(parser)
    options = parser.parse_args()
    runs, rates, stages = [], [], []
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(options.runs):
            runs.append(timed("-m", "meshskin", "run", options.scene, "--out", folder, "--quiet"))
            metrics = json.loads((Path(folder) / "metrics.json").read_text())
            rates.append(metrics["steps_per_second"])
            stages.append(metrics["seconds"])
    bare = statistics.median(timed("-c", "pass") for _ in range(options.runs))
    imports = [timed("-c", "import meshskin") - bare for _ in range(options.runs)]
    found = {
        "run_s": statistics.median(runs),
        "import_s": statistics.median(imports),
        "steps_per_second": statistics.median(rates),
    }
    print(f"meshskin run {options.scene}: median {found['run_s']:.2f} s, best {min(runs):.2f} s")
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
