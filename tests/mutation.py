"""Mutation check: whether the tests notice a wrong sign, constant or exponent.

    python tests/mutation.py                 every mutant of tests/mutants.toml
    python tests/mutation.py contact joint   those whose file or text contains one of the words

Each mutant replaces one piece of text of the package in a copy of the checkout. The tests named
beside it run until the first failure; a mutant is killed when a test fails, and survives when all
pass. Outcomes are printed and recorded in tests/mutation.csv, where those of other mutants stay.
Exit code 1 if fewer than 90 % are killed. (mutmut and cosmic-ray were weighed: they mutate every
line, and one run of this suite a mutant takes days.)
"""

from __future__ import annotations

import csv
import os
import shutil
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
SHARE = 0.9
"""Least share of mutants that must be killed."""
DEEP = ("-m", "not slow and not docs")
"""Tests of more than a second, which the default run leaves out, run here."""
COPIED = ("meshskin", "tests", "studies", "bodies", "pyproject.toml", "README.md")


def run(tests: list[str], folder: Path) -> int:
    """Exit code of pytest in a copy of the checkout: 0 when all tests pass, 1 when one fails."""
    environment = {**os.environ, "PYTHONPATH": str(folder), "OMP_NUM_THREADS": "1"}
    environment.setdefault("MESHSKIN_DATA", str(ROOT.parent / "shared" / "data"))
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *DEEP, *tests]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True).returncode


def outcome(mutant: dict[str, str], folder: Path) -> str:
    """Run one mutant: "killed" or "survived"; the copy in `folder` is as before when it returns."""
    path = folder / mutant["file"]
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace(mutant["old"], mutant["new"]), encoding="utf-8")
    try:
        code = run(mutant["tests"].split(), folder)
    finally:
        path.write_text(text, encoding="utf-8")
    if code not in (0, 1, 2):
        raise SystemExit(f"pytest {mutant['tests']} ended with exit code {code}")
    return "killed" if code else "survived"


def check(mutants: list[dict[str, str]]) -> None:
    """Raise SystemExit unless the text of each mutant occurs once in its file."""
    for mutant in mutants:
        count = (ROOT / mutant["file"]).read_text(encoding="utf-8").count(mutant["old"])
        if count != 1:
            raise SystemExit(
                f"{mutant['file']} must contain {mutant['old']!r} once, not {count} times: "
                "correct tests/mutants.toml"
            )


def record(rows: list[tuple[str, str, str, str]], mutants: list[dict[str, str]]) -> None:
    """Update tests/mutation.csv; mutants that are no longer in the table are removed."""
    path, known = ROOT / "tests" / "mutation.csv", {}
    if path.is_file():
        with path.open(newline="", encoding="utf-8") as file:
            known = {tuple(row[1:]): row[0] for row in csv.reader(file)}
    known |= {row[1:]: row[0] for row in rows}
    keys = [(m["file"], m["old"], m["new"]) for m in mutants]
    with path.open("w", newline="", encoding="utf-8") as file:
        table = [(known[key], *key) for key in keys if key in known]
        csv.writer(file, lineterminator="\n").writerows([("outcome", "file", "old", "new"), *table])


def main(words: list[str]) -> int:
    """Run the mutants that contain one of the words, or all; returns the exit code."""
    mutants = tomllib.loads((ROOT / "tests" / "mutants.toml").read_text(encoding="utf-8"))["mutant"]
    chosen = [m for m in mutants if not words or any(w in m["file"] + m["old"] for w in words)]
    check(chosen)
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        for name in COPIED:
            if (ROOT / name).is_dir():
                shutil.copytree(ROOT / name, folder / name)
            else:
                shutil.copy(ROOT / name, folder / name)
        for tests in sorted({m["tests"] for m in chosen}):
            if run(tests.split(), folder):
                raise SystemExit(f"pytest {tests} must pass without a mutant")
        for mutant in chosen:
            rows.append((outcome(mutant, folder), mutant["file"], mutant["old"], mutant["new"]))
            print("{:9} {}: {!r} -> {!r}".format(*rows[-1]), flush=True)
            record(rows, mutants)
    killed = sum(row[0] == "killed" for row in rows)
    print(f"{killed} of {len(rows)} mutants killed ({killed / len(rows):.0%})")
    return int(killed < SHARE * len(rows))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
