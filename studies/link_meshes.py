"""The whole job on every link mesh below some folders: which taxels are confidently wrong.

    python studies/link_meshes.py FOLDER ... --out links.jsonl [--skins 3] [--only UR3E] [--step 8]

FOLDER holds mesh files of any format that `Body.load` reads, such as the meshes of the
example-robot-data wheel (extra `robots`); single files can be named, too. Every mesh gets --skins
skins of 60 taxels in caps of random directions; --only takes the paths that contain a word,
--step 8 every eighth mesh, --from 3 from the third on; --first-seed 4 draws other skins. Rows are
written as they come; a repeated call skips those that --out holds, so that a study can be run in
slices. A figure beside it (links.png) has the errors of the skins by verdict.
--lane-mm 4 leaves taxels that one lane touches only, where two positions fit; with --unknown-noise
the belief does not know the noise.
Small links (below 60 mm) are pressed with 1 N on an indenter of 2 mm (1.2 MPa, where the contact
models hold), others with 3 N on 8 mm (0.4 MPa); they are moved without an arm in lanes 2.5 mm
apart (--lane-mm), with 1 % noise. A taxel is confidently wrong if its
error exceeds both 0.3 mm and 5 standard deviations. Exit code 1 if there is one, or a crash;
refused meshes are listed.
"""

from __future__ import annotations

import argparse
import json
import sys
import traceback
import warnings
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
from dots import dots
from setups import load_link, mesh_files, pressed

import meshskin as ms
from meshskin.core.errors import MeshskinError
from meshskin.exploration.plan import plan_exploration
from meshskin.geometry.region import Cap
from meshskin.report import theme

ERROR, SIGMAS = 0.3, 5.0
"""Error, mm, and error relative to the stated standard deviation of a taxel that is wrong."""
SMALL = 0.06
"""Largest extent, m, of a small link."""
TAXELS = 60
"""Taxels of a skin."""
MAX_PLANNING = 10.0
"""Processor time of a plan, s, above which it is listed."""


@dataclass(frozen=True)
class Conditions:
    """What a skin is calibrated from."""

    lane: float = 2.5e-3
    """Distance of the lanes, m."""
    noise_known: bool = True
    """Whether the belief knows the noise of the readings."""


def main() -> int:
    """Run every mesh and skin; exit code 1 where a taxel is confidently wrong."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--out", type=Path, default=Path("links.jsonl"))
    parser.add_argument("--skins", type=int, default=1)
    parser.add_argument("--first-seed", type=int, default=1)
    parser.add_argument("--only", default="")
    parser.add_argument("--step", type=int, default=1)
    parser.add_argument("--from", type=int, default=1, dest="first")
    parser.add_argument("--lane-mm", type=float, default=2.5)
    parser.add_argument("--unknown-noise", action="store_true")
    options = parser.parse_args()
    chosen = Conditions(1e-3 * options.lane_mm, not options.unknown_noise)
    files = [file for file in mesh_files(options.folders) if options.only in str(file)]
    seeds = range(options.first_seed, options.first_seed + options.skins)
    rows = run(files[options.first - 1 :: options.step], seeds, options.out, chosen)
    print(summary(rows))
    theme.save(dots(errors(rows), "rms error of a skin (mm)"), options.out.parent, options.out.stem)
    return int(any(map(is_defect, rows)))


def is_defect(row: dict[str, Any]) -> bool:
    """Whether a skin has a confidently wrong taxel, or crashed."""
    return bool(row["wrong"]) or "crash" in row


def run(
    files: list[Path], seeds: range, out: Path, conditions: Conditions = Conditions()
) -> list[dict[str, Any]]:
    """The rows of all files and skins; those that `out` does not hold are appended to it."""
    known = out.read_text(encoding="utf-8").splitlines() if out.exists() else []
    done = {(r["mesh"], r["seed"]): r for r in map(json.loads, known)}
    rows = []
    with out.open("a", encoding="utf-8") as stream:
        for file in files:
            for seed in seeds:
                if (found := done.get((str(file), seed))) is None:
                    found = row(file, seed, conditions)
                    stream.write(json.dumps(found) + "\n")
                    stream.flush()
                    print(line(found), flush=True)
                rows.append(found)
    return rows


def row(file: Path, seed: int, conditions: Conditions = Conditions()) -> dict[str, Any]:
    """The result of one skin, or why it was refused, or where it crashed."""
    begin = process_time()
    out: dict[str, Any] = {"mesh": str(file), "seed": seed, "found": 0, "wrong": []}
    try:
        scene = link_scene(file, seed, conditions.lane)
        ready = process_time()
        plan = plan_exploration(scene)
        out |= {"body_seconds": ready - begin, "plan_seconds": process_time() - ready}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # bumps that the force does not follow
            recording = ms.simulate(scene, seed=1, path=plan.path)
        unknown = {} if conditions.noise_known else {"noise_sigma": None}
        calibration = ms.calibrate(recording, scene.belief(**unknown))
    except MeshskinError as refusal:
        return out | {"refused": str(refusal), "seconds": process_time() - begin}
    except Exception as crash:
        where = traceback.extract_tb(crash.__traceback__)[-1]
        words = f"{type(crash).__name__}: {crash} ({Path(where.filename).name}:{where.lineno})"
        return out | {"crash": words, "seconds": process_time() - begin}
    error = 1e3 * np.linalg.norm(calibration.positions - scene.skin.positions, axis=1)
    sigma = 1e3 * calibration.position_sigma
    wrong = np.flatnonzero((error > ERROR) & (error > SIGMAS * sigma))
    found = np.isfinite(error)
    return out | {
        "open": not scene.body.mesh.is_watertight,
        "taxels": len(found),
        "reached": len(found) - len(plan.unreachable),
        "found": int(found.sum()),
        "rms_mm": float(np.sqrt(np.mean(error[found] ** 2))) if found.any() else None,
        "wrong": [[int(calibration.ids[k]), float(error[k]), float(sigma[k])] for k in wrong],
        "verdict": calibration.verdict.level if calibration.verdict else None,
        "seconds": process_time() - begin,
    }


def summary(rows: list[dict[str, Any]]) -> str:
    """The counts: taxels by verdict, confidently wrong ones, refusals, crashes, slow plans."""
    found, wrong, skins = Counter[str](), Counter[str](), Counter[str]()
    for r in rows:
        level = r.get("verdict") or ("crash" if "crash" in r else "refused")
        skins[level] += 1
        found[level] += r["found"]
        wrong[level] += len(r["wrong"])
    text = f"{found.total()} taxels on {len(rows)} skins, {wrong.total()} confidently wrong"
    for level in sorted(skins):
        text += f"\n    {level}: {skins[level]} skins, {found[level]} taxels, {wrong[level]} wrong"
    for r in rows:
        if r.get("plan_seconds", 0.0) > MAX_PLANNING:
            text += f"\n    planning took {r['plan_seconds']:.0f} s: {r['mesh']} {r['seed']}"
    return text


def errors(rows: list[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Quantiles of the rms errors of the skins, mm, by verdict."""
    found: dict[str, list[float]] = {}
    for r in rows:
        if r.get("rms_mm") is not None:
            found.setdefault(r["verdict"], []).append(r["rms_mm"])
    parts = {"median": 0.5, "95 %": 0.95, "largest": 1.0}
    return {
        f"{level}, {len(mm)} skins": {name: float(np.quantile(mm, q)) for name, q in parts.items()}
        for level, mm in sorted(found.items())
    }


def link_scene(file: Path, seed: int, lane: float) -> ms.Scene:
    """A link with a skin of TAXELS in a cap of a random direction, moved over an indenter."""
    body = load_link(file)
    small = float(body.mesh.extents.max()) < SMALL
    direction = np.random.default_rng(seed).normal(size=3)
    skin = ms.Skin.cover(
        body, spacing=3e-3 if small else 6e-3, count=TAXELS, seed=seed,
        region=Cap(direction=tuple(direction / np.linalg.norm(direction))),
        disc_radius=1e-3 if small else 2e-3,
    )  # fmt: skip
    radius, young, force = (2e-3, 1.2e6, 1.0) if small else (8e-3, 0.4e6, 3.0)
    return pressed(skin, body, file.stem, radius=radius, young=young, force=force, lane=lane)


def line(row: dict[str, Any]) -> str:
    """One row of the table."""
    name = f"{Path(row['mesh']).name[:40]:40s} {row['seed']}"
    for what in ("refused", "crash"):
        if what in row:
            return f"{name} {what}: {row[what]}"
    text = f"{name} {row['verdict']:5s} {row['found']:4d} found"
    if row["found"]:
        text += f", rms {row['rms_mm']:.3f} mm, {row['seconds']:.0f} s"
    return text + "".join(f"\n    taxel {k}: {e:.3f} mm off at {s:.3f}" for k, e, s in row["wrong"])


if __name__ == "__main__":
    sys.exit(main())
