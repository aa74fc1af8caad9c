"""How much of a link's visible surface is calibrated, bare and in a bridging skin.

    python studies/skinned_links.py MESH ... --radius-mm 8 --force-n 3 --out skinned.jsonl

MESH is a mesh file of any format that `Body.load` reads, or a folder that holds some. Each is
covered by --taxels taxels all over, as it is and as `Body.skinned` gives it (--thickness-mm,
--feature-mm), moved by hand over the indenter in lanes (--lane-mm), with 1 % noise, and calibrated.
Points spread evenly over the mesh are the measure, the same for both: a point counts as visible if
one of 64 directions leads away from it, and as fitting if a sphere of the indenter's radius that
touches it there overlaps no other point of the mesh by 0.1 mm (a test by dense samples, independent
of the planner). It counts as calibrated if the taxel nearest to it on its side is; on a skin only
where the skin bridges it by at most --bridge-mm.

The table lists the shares: visible points that fit; fitting points that are calibrated; visible
points that are calibrated; the largest error of a calibrated taxel, mm, and how many are
confidently wrong; and the area, mm^2, of the fitting points that are not calibrated, by the reason
of the nearest taxel. Below it, for each kind: the medians over the meshes, the share of the pooled
area that fits, on how many meshes GOAL of what fits is calibrated, and the pooled area that is
lost, by reason. A figure beside --out (skinned.png) has the shares of the visible points. --kind
takes one of the surfaces; a repeated call skips what --out holds.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
import trimesh
from dots import dots
from link_meshes import ERROR, SIGMAS
from scipy.spatial import cKDTree
from setups import load_link, mesh_files, pressed

import meshskin as ms
from meshskin.core.errors import MeshskinError
from meshskin.report import theme

KINDS = ["bare", "skinned"]
"""Surfaces that are pressed."""
GOAL = 0.9
"""Share of what fits that is to be calibrated on every mesh."""
POINTS = 1500
"""Points of a mesh."""
DENSE = 300_000
"""Samples of a mesh for the test of fit."""
OVERLAP = 0.1e-3
"""Overlap of a sphere with the mesh that still counts as a fit, m."""


def main() -> int:
    """Print the table of all meshes, and its summary."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("meshes", nargs="+", type=Path)
    parser.add_argument("--radius-mm", type=float, default=8.0)
    parser.add_argument("--force-n", type=float, default=3.0)
    parser.add_argument("--young-kpa", type=float, default=400.0)
    parser.add_argument("--thickness-mm", type=float, default=4.0)
    parser.add_argument("--feature-mm", type=float, help="default: 1.5 indenter radii")
    parser.add_argument("--bridge-mm", type=float, default=0.5)
    parser.add_argument("--lane-mm", type=float, default=2.5)
    parser.add_argument("--taxels", type=int, default=300)
    parser.add_argument("--kind", nargs="+", choices=KINDS, default=KINDS)
    parser.add_argument("--out", type=Path, default=Path("skinned.jsonl"))
    options = parser.parse_args()
    known = options.out.read_text(encoding="utf-8").splitlines() if options.out.exists() else []
    rows = [json.loads(text) for text in known]
    done = {(row["file"], row["kind"]) for row in rows}
    with options.out.open("a", encoding="utf-8") as out:
        for file in mesh_files(options.meshes):
            kinds = [kind for kind in options.kind if (str(file), kind) not in done]
            for row in measure_mesh(file, kinds, options) if kinds else ():
                rows.append(row)
                out.write(json.dumps(row) + "\n")
                out.flush()
                print(line(row), flush=True)
    for kind in options.kind:
        print(summary([row for row in rows if row["kind"] == kind]))
    shown: dict[str, dict[str, float | None]] = {}
    for row in rows:
        shown.setdefault(row["mesh"], {})[row["kind"]] = row.get("visible_calibrated")
    figure = dots(shown, "share of the visible points that are calibrated")
    theme.save(figure, options.out.parent, options.out.stem)
    return int(any(row.get("wrong") for row in rows))


def summary(rows: list[dict[str, Any]]) -> str:
    """Medians over the meshes of one kind, pooled areas, and what is lost, the largest first; a
    surface that is refused counts as not calibrated, a mesh that cannot be a body as no area."""
    if not rows:
        return "none"
    fit = np.array([row.get("fit_calibrated", 0.0) for row in rows])
    seen = np.array([row.get("visible_calibrated", 0.0) for row in rows])
    area, lost = sum(row["fit_mm2"] for row in rows), Counter[str]()
    for row in rows:
        lost.update(row.get("lost_mm2", {"refused": row["fit_mm2"]}))
    wrong = sum(len(row.get("wrong", ())) for row in rows)
    pooled = 1.0 - lost.total() / max(area, 1)
    text = (
        f"{rows[0]['kind']}, {len(rows)} meshes: medians {np.median(fit):.0%} of what fits, "
        f"{np.median(seen):.0%} of what is visible; pooled {pooled:.0%} of what fits; "
        f"{GOAL:.0%} of what fits on {(fit >= GOAL).sum()} meshes; {wrong} taxels wrong"
    )
    return text + "".join(
        f"\n    {part / max(area, 1):6.1%} {why}" for why, part in lost.most_common()
    )


def measure_mesh(
    file: Path, kinds: list[str], options: argparse.Namespace
) -> Iterator[dict[str, Any]]:
    """The rows of one mesh, by kind."""
    try:
        body = load_link(file)
    except MeshskinError as refusal:
        row = {"file": str(file), "mesh": file.stem, "fits": 0.0, "fit_mm2": 0}
        yield from (row | {"kind": kind, "refused": str(refusal)} for kind in kinds)
        return
    radius = 1e-3 * options.radius_mm
    points, normals = even_points(body.mesh)
    seen = visible(body.mesh, points, normals)
    fits = sphere_fits(body.mesh, points, normals, radius)
    feature = 1.5 * radius if options.feature_mm is None else 1e-3 * options.feature_mm
    thickness, cell = 1e-3 * options.thickness_mm, 1e6 * body.mesh.area / len(points)
    for kind in kinds:
        row = {"file": str(file), "mesh": file.stem, "kind": kind}
        row |= {"fits": share(fits, seen), "fit_mm2": cell * int((seen & fits).sum())}
        begin = process_time()
        try:
            surface = body if kind == "bare" else body.skinned(thickness, feature)
            found = calibrated(surface, radius, options)
        except MeshskinError as refusal:
            yield row | {"refused": str(refusal)}
            continue
        depth = surface.closest(points).distance
        far = np.abs(depth) - (thickness if kind == "skinned" else 0.0)
        bridged = far > 1e-3 * options.bridge_mm
        why = np.where(bridged, "bridged", found.reasons_at(points, normals))
        good = why == ""
        yield row | {
            "fit_calibrated": share(good, seen & fits),
            "visible_calibrated": share(good, seen),
            "bridged": share(bridged, seen),
            "largest_error_mm": found.largest_error,
            "wrong": found.wrong,
            "lost_mm2": {
                reason: round(cell * count)
                for reason, count in Counter(why[seen & fits & ~good].tolist()).most_common()
            },
            "surface": surface.repairs[-1:] if kind == "skinned" else [],
            "seconds": process_time() - begin,
        }


def even_points(mesh: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) spread by area over the mesh, and the normals (n, 3) of their faces."""
    points, face = trimesh.sample.sample_surface(mesh, POINTS, seed=1)
    return np.asarray(points), mesh.face_normals[face]


def visible(mesh: trimesh.Trimesh, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Whether (n,) a straight line in front of a point leads away from the mesh."""
    ways = np.random.default_rng(0).normal(size=(64, 3))
    ways /= np.linalg.norm(ways, axis=1)[:, None]
    out = np.zeros(len(points), dtype=bool)
    # embree is single precision: in units of the extent, and a little off the surface
    scale = float(mesh.extents.max())
    scaled = trimesh.Trimesh(mesh.vertices / scale, mesh.faces, process=False)
    start = points / scale + 1e-4 * normals
    for way in ways:
        front = np.flatnonzero(~out & (normals @ way > 0.1))
        if len(front):
            ahead = np.repeat(way[None], len(front), axis=0)
            out[front] = ~scaled.ray.intersects_any(start[front], ahead)
    return out


def sphere_fits(
    mesh: trimesh.Trimesh, points: np.ndarray, normals: np.ndarray, radius: float
) -> np.ndarray:
    """Whether (n,) a sphere in front of a point overlaps no sample of the mesh."""
    samples = trimesh.sample.sample_surface(mesh, DENSE, seed=2)[0]
    gap = cKDTree(samples).query(points + radius * normals)[0]
    return np.asarray(gap > radius - OVERLAP)


class Found:
    """What a calibration found of the taxels of a surface."""

    def __init__(self, skin: ms.Skin, calibration: Any, unreachable: dict[str, str]) -> None:
        good = np.isfinite(calibration.positions[:, 0])
        reasons = [
            unreachable.get(str(taxel), f"not determined: {reason}")
            for taxel, reason in zip(skin.ids, calibration.reasons, strict=True)
        ]
        self._skin, self._reasons = skin, np.where(good, "", reasons)
        error = np.linalg.norm(calibration.positions - skin.positions, axis=1)[good]
        self.largest_error = float(1e3 * error.max(initial=0.0))
        sigma = calibration.position_sigma[good]
        rows = np.flatnonzero((1e3 * error > ERROR) & (error > SIGMAS * sigma))
        self.wrong = [[float(1e3 * error[k]), float(1e3 * sigma[k])] for k in rows]
        """Error and stated standard deviation, mm, of the taxels that are confidently wrong."""

    def reasons_at(self, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Why (n,) the nearest taxel that faces the same way is not calibrated; "" where it is."""
        near = cKDTree(self._skin.positions).query(points, 8)[1]
        facing = np.einsum("nc,nkc->nk", normals, self._skin.normals[near]) > 0.3
        first = near[np.arange(len(near)), np.argmax(facing, axis=1)]
        return np.where(facing.any(axis=1), self._reasons[first], "no taxel near")


def calibrated(body: ms.Body, radius: float, options: argparse.Namespace) -> Found:
    """The taxels all over a body after simulation and calibration."""
    skin = ms.Skin.cover(body, count=options.taxels, seed=1, disc_radius=min(2e-3, 0.3 * radius))
    scene = pressed(
        skin, body, body.name, radius=radius, young=1e3 * options.young_kpa,
        force=options.force_n, lane=1e-3 * options.lane_mm,
    )  # fmt: skip
    recording = ms.simulate(scene, seed=1)
    calibration = ms.calibrate(recording, scene.belief())
    return Found(skin, calibration, recording.metadata.get("unreachable", {}))


def share(of: np.ndarray, among: np.ndarray) -> float:
    """The share of True values of `of` (n,) where `among` (n,) is True."""
    return float(of[among].mean()) if among.any() else float("nan")


def line(row: dict[str, Any]) -> str:
    """One row of the table."""
    head = f"{row['mesh'][:36]:36s} {row['kind']:8s} fits {row['fits']:4.0%}"
    if "refused" in row:
        return f"{head}  refused: {row['refused']}"
    return (
        f"{head}  calibrated {row['fit_calibrated']:4.0%} of fitting, "
        f"{row['visible_calibrated']:4.0%} of visible ({row['bridged']:.0%} bridged), error up to "
        f"{row['largest_error_mm']:.3f} mm, {len(row['wrong'])} wrong, {row['seconds']:.0f} s  "
        f"{row['lost_mm2']}"
    )


if __name__ == "__main__":
    sys.exit(main())
