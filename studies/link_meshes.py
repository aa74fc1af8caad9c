"""The whole job on every link mesh below some folders: which taxels are confidently wrong.

    python studies/link_meshes.py FOLDER ... --out links.jsonl [--skins 3] [--step 8]

FOLDER holds STL files, such as the meshes of the example-robot-data wheel (extra `robots`). Every
mesh gets --skins skins of 60 taxels in caps of random directions; --step 8 takes every eighth mesh.
Small links (below 60 mm) are pressed with 1 N on an indenter of 2 mm, others with 3 N on 8 mm;
they are moved by hand in lanes 2.5 mm apart, with 1 % noise. A taxel is confidently wrong if its
error exceeds both 0.3 mm and 5 standard deviations. Exit code 1 if there is one; refused meshes are
listed.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import trimesh

import meshskin as ms
from meshskin.core.errors import MeshError, MeshskinError
from meshskin.geometry.region import Cap

ERROR, SIGMAS = 0.3, 5.0
"""Error, mm, and error relative to the stated standard deviation of a taxel that is wrong."""
SMALL = 0.06
"""Largest extent, m, of a small link."""
LARGEST_IN_METRES = 5.0
"""Extent of a file above which its unit is mm."""
TAXELS = 60
"""Taxels of a skin."""


def main() -> int:
    """Run every mesh and skin; exit code 1 where a taxel is confidently wrong."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--out", type=Path, default=Path("links.jsonl"))
    parser.add_argument("--skins", type=int, default=1)
    parser.add_argument("--step", type=int, default=1)
    options = parser.parse_args()
    files = {file for folder in options.folders for file in folder.rglob("*") if is_stl(file)}
    rows = []
    with options.out.open("w", encoding="utf-8") as out:
        for file in sorted(files)[:: options.step]:
            for seed in range(1, options.skins + 1):
                rows.append(row(file, seed))
                out.write(json.dumps(rows[-1]) + "\n")
                print(line(rows[-1]), flush=True)
    wrong = sum(len(r["wrong"]) for r in rows)
    found = sum(r["found"] for r in rows)
    print(f"{found} taxels on {len(rows)} skins, {wrong} confidently wrong")
    return int(wrong > 0)


def is_stl(file: Path) -> bool:
    """Whether a file is an STL file by its suffix."""
    return file.suffix.lower() == ".stl"


def row(file: Path, seed: int) -> dict[str, Any]:
    """The result of one skin, or why it was refused."""
    begin = perf_counter()
    out: dict[str, Any] = {"mesh": str(file), "seed": seed, "found": 0, "wrong": []}
    try:
        scene = link_scene(file, seed)
        calibration = ms.calibrate(ms.simulate(scene, seed=1), scene.belief())
    except MeshskinError as refusal:
        return out | {"refused": str(refusal), "seconds": perf_counter() - begin}
    error = 1e3 * np.linalg.norm(calibration.positions - scene.skin.positions, axis=1)
    sigma = 1e3 * calibration.position_sigma
    wrong = np.flatnonzero((error > ERROR) & (error > SIGMAS * sigma))
    found = np.isfinite(error)
    return out | {
        "found": int(found.sum()),
        "rms_mm": float(np.sqrt(np.mean(error[found] ** 2))),
        "wrong": [[int(calibration.ids[k]), float(error[k]), float(sigma[k])] for k in wrong],
        "verdict": calibration.verdict.level if calibration.verdict else None,
        "seconds": perf_counter() - begin,
    }


def link_scene(file: Path, seed: int) -> ms.Scene:
    """A link with a skin of TAXELS in a cap of a random direction, moved over an indenter."""
    extent = float(np.max(trimesh.load(file, process=False).extents))
    units = "mm" if extent > LARGEST_IN_METRES else "m"
    small = extent * (1e-3 if units == "mm" else 1.0) < SMALL
    try:
        body = ms.Body.load(file, units=units)
    except MeshError:
        body = ms.Body.load(file, units=units, open=True)
    direction = np.random.default_rng(seed).normal(size=3)
    skin = ms.Skin.cover(
        body, spacing=3e-3 if small else 6e-3, count=TAXELS, seed=seed,
        region=Cap(direction=tuple(direction / np.linalg.norm(direction))),
        disc_radius=1e-3 if small else 2e-3,
    )  # fmt: skip
    base = ms.Scene.load("sphere_noisy")
    return base.with_(
        name=file.stem,
        body=body,
        skin=skin,
        contact="auto",
        material=ms.Material(young=0.4e6),
        indenter=ms.Indenter.sphere(2e-3 if small else 8e-3),
        law=replace(base.law, force_reference=1.0 if small else 3.0),
        loop=replace(base.loop, mode="quasi_static"),
        exploration=replace(base.exploration, pattern="lanes", lane_spacing=2.5e-3),
    )


def line(row: dict[str, Any]) -> str:
    """One row of the table."""
    name = f"{Path(row['mesh']).name[:40]:40s} {row['seed']}"
    if "refused" in row:
        return f"{name} refused: {row['refused']}"
    text = f"{name} {row['found']:4d} found, rms {row['rms_mm']:.3f} mm, {row['seconds']:.0f} s"
    return text + "".join(f"\n    taxel {k}: {e:.3f} mm off at {s:.3f}" for k, e, s in row["wrong"])


if __name__ == "__main__":
    sys.exit(main())
