"""The whole job on bodies of real robots: UR3e forearm, iCub left forearm, iCub left shank.

    python studies/real_bodies.py DATA --out figures/ [--only NAME ...] [--full]

DATA is a folder that holds ur3e_meshes/ and icub_body/ as published by their sources. The UR3e's
forearm and the iCub's shank get a lattice of taxels (150 and 250; the whole surface with --full),
the iCub's forearm the modules of left_forearm_V2 at the poses in its URDF. The body is moved
without arm dynamics (quasi-static) over an indenter of 8 mm in lanes 2.5 mm apart; noise is 1 % of
the peak pressure. A taxel is reached if the plan gives no reason against contacts on it.

The table lists taxels, those that are reached, touched and found, the RMS error in mm of those
reached and found in three draws of the noise, their Cramér-Rao bound, and seconds; below it, why
taxels were not reached or not found. The CAD meshes are coarse: dihedral angles of up to 20 degrees
count as smooth, larger ones as edges, and no contact patch may overlap an edge.

With --full, every link mesh of DATA and of the example-robot-data wheel (extra `robots`), closed or
open, gets three skins as in link_meshes.py; the taxels that are confidently wrong are counted, and
the rows written to link_meshes.jsonl in --out, where a repeated call continues. DATA may then be
any folder of meshes: of the three bodies, those that it holds are measured.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from time import perf_counter
from typing import Any
from xml.etree import ElementTree

import link_meshes
import numpy as np
from setups import mesh_files, pressed

import meshskin as ms
from meshskin.core.atomic_io import write_json
from meshskin.estimation.uncertainty import metrics
from meshskin.exploration.plan import plan_exploration
from meshskin.geometry.region import Cap
from meshskin.report import theme
from meshskin.skin.skin import Modules

MESHES = {
    "UR3e forearm": "ur3e_meshes/forearm.stl",
    "iCub left forearm": "icub_body/meshes/sim_sea_2-5_l_forearm_prt-binary.stl",
    "iCub left shank": "icub_body/meshes/sim_sea_2-5_l_shank_prt-binary.stl",
}
URDF = "icub_body/iCubGazeboV2_5.urdf"
BOUND = 1.2
"""Largest RMS error over the Cramer-Rao bound."""
WIDTH, HEIGHT, ZOOM = 2.6, 4.0, 1.04
"""Size of a body's picture, inches, and how much of it the body fills."""
LARGEST = 0.05
"""Error, mm, from which taxels have one colour: the largest is some tenths of a millimetre."""
SEEDS = range(1, 4)
"""Seeds of the skins of every link mesh."""
DRAWS = range(1, 4)
"""Seeds of the noise: the RMS error in one draw is that of few taxels with few contacts, and varies
by 15 % about its mean on the shank."""


def main() -> int:
    """Print the table, draw the picture; exit code 1 where an error is above its bound."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--out", type=Path, default=Path("figures"))
    parser.add_argument("--only", nargs="+", choices=BODIES)
    parser.add_argument("--full", action="store_true")
    options = parser.parse_args()
    held = [name for name, file in MESHES.items() if (options.data / file).is_file()]
    if not (held or options.only or options.full):
        parser.error(f"{options.data} holds none of {', '.join(MESHES)}: give --full")
    rows, maps = [], {}
    for name in options.only or held:
        row, maps[name] = measure_body(name, options.data, options.full)
        rows.append(row)
        print(row_text(row), flush=True)
    if rows:
        write_json(options.out / "real_bodies.json", rows)
        draw_bodies(maps, options.out)
    good = all(row["ratio"] <= BOUND for row in rows)
    if options.full:
        files = mesh_files([options.data]) + wheel_meshes()
        links = link_meshes.run(files, SEEDS, options.out / "link_meshes.jsonl")
        print(link_meshes.summary(links))
        good &= not any(link_meshes.is_defect(row) for row in links)
    return 0 if good else 1


def wheel_meshes() -> list[Path]:
    """The STL files of the example-robot-data wheel; none where it is not installed."""
    try:
        files = metadata.files("example-robot-data") or []
    except metadata.PackageNotFoundError:
        return []
    return [Path(f.locate()) for f in files if f.suffix.lower() == ".stl"]


def ur3e(data: Path, full: bool) -> tuple[ms.Body, ms.Skin]:
    """The forearm, and taxels on its side."""
    body = ms.Body.load(data / MESHES["UR3e forearm"], units="m")
    return body, _cover(body, 6e-3, None if full else 150, (1.0, 0.0, 0.0))


def _cover(
    body: ms.Body, spacing: float, count: int | None, direction: tuple[float, float, float]
) -> ms.Skin:
    """Taxels about the place that faces `direction`, or, without a count, all over."""
    region = None if count is None else Cap(direction=direction)
    return ms.Skin.cover(body, spacing=spacing, count=count, region=region, seed=1)


def shank(data: Path, full: bool) -> tuple[ms.Body, ms.Skin]:
    """The shank, and taxels on its front."""
    body = ms.Body.load(data / MESHES["iCub left shank"], units="mm", open=True)
    return body, _cover(body, 7e-3, None if full else 250, (1.0, 0.0, 0.0))


def forearm(data: Path, full: bool) -> tuple[ms.Body, ms.Skin]:
    """The forearm with its 24 modules, brought onto the mesh from their places in the link.

    A module's turn about its normal is not in the URDF: it is taken as the frame has it.
    """
    body = ms.Body.load(data / MESHES["iCub left forearm"], units="mm", open=True)
    frames = ms.Skin.load(data / URDF, part="l_forearm")
    poses = np.array(frames.poses)
    poses[:, :3, 3] -= _origin(data / URDF, "l_forearm")
    return body, Modules(poses, np.array(frames.ids)).skin.onto(body)


def _origin(urdf: Path, link: str) -> np.ndarray:
    """Where (3,), m, a link's mesh has its origin in the link's frame."""
    origin = ElementTree.parse(urdf).find(f"link[@name='{link}']/visual/origin")
    assert origin is not None
    return np.array([float(x) for x in origin.get("xyz", "0 0 0").split()])


BODIES: dict[str, Callable[[Path, bool], tuple[ms.Body, ms.Skin]]] = {
    "UR3e forearm": ur3e,
    "iCub left forearm": forearm,
    "iCub left shank": shank,
}


def measure_body(
    name: str, data: Path, full: bool = False
) -> tuple[dict[str, Any], tuple[Any, ...]]:
    """One body's row of the table, and what is drawn of it: positions (n, 3), errors (n,), mm."""
    started = perf_counter()
    body, skin = BODIES[name](data, full)
    world = pressed(skin, body, name, radius=0.008, young=0.4e6, contact="elliptic")
    explored = plan_exploration(world)
    errors, variances = [], []
    for seed in reversed(DRAWS):  # the first is counted and drawn
        recording = ms.simulate(world, seed=seed, path=explored.path)
        calibration = ms.calibrate(recording, world.belief())
        reached = ~np.isin(calibration.ids, list(explored.unreachable))
        found = np.isfinite(calibration.positions[:, 0])
        limit = metrics.cramer_rao(recording, world.belief(), world.skin)
        error = 1e3 * metrics.position_errors(calibration, world.skin)
        variance = np.trace(limit.covariance, axis1=1, axis2=2)
        both = reached & found & np.isfinite(variance)
        errors.append(error[both])
        variances.append(variance[both])
    rms = float(np.sqrt(np.mean(np.concatenate(errors) ** 2)))
    bound = 1e3 * float(np.sqrt(np.mean(np.concatenate(variances))))
    why = Counter(explored.unreachable.values())
    lost = Counter(str(w) for w in calibration.reasons[reached & ~found])
    row = {
        "body": name,
        "taxels": len(found),
        "reached": int(reached.sum()),
        "touched": int(calibration.touched.sum()),
        "found": int((reached & found).sum()),
        "rms_mm": rms,
        "bound_mm": bound,
        "ratio": rms / bound,
        "seconds": perf_counter() - started,
        "not_reached": dict(why),
        "not_found": dict(lost),
    }
    return row, (world.body, world.skin.positions, np.where(reached & found, error, np.nan))


def row_text(row: dict[str, Any]) -> str:
    """One row of the table, and the reasons below it."""
    text = (
        f"{row['body']:18s} {row['taxels']:5d} taxels {row['reached']:5d} reached "
        f"{row['touched']:5d} touched {row['found']:5d} found  {row['rms_mm']:.4f} mm rms, bound "
        f"{row['bound_mm']:.4f}, ratio {row['ratio']:.2f}  {row['seconds']:.0f} s"
    )
    for what, reasons in (("reached", row["not_reached"]), ("found", row["not_found"])):
        for why, count in sorted(reasons.items(), key=lambda item: -item[1]):
            text += f"\n    {count:5d} not {what}: {why}"
    return text


@theme.styled
def draw_bodies(maps: dict[str, tuple[Any, ...]], out: Path) -> None:
    """The bodies, their taxels coloured by the error; crosses where none was reached or found."""
    figure = theme.new_figure(WIDTH * len(maps) + 1.0, HEIGHT)
    for k, (name, (body, positions, error)) in enumerate(maps.items()):
        # 3D axes are square, whatever is drawn in them: they overlap
        wide = figure.get_figwidth()
        place = ((k + 0.5) * WIDTH - HEIGHT / 2) / wide, 0.0, HEIGHT / wide, 0.95
        axes: Any = figure.add_axes(place, projection="3d")
        axes.patch.set_alpha(0.0)
        side = _facing(body.mesh.vertices, body.closest(positions).normal.mean(axis=0))
        corners = body.mesh.vertices @ side.T
        axes.plot_trisurf(
            *corners.T, triangles=body.mesh.faces, color="0.85", alpha=0.3, linewidth=0.0
        )
        x = positions @ side.T
        good = np.isfinite(error)
        axes.scatter(*x[~good].T, marker="x", s=9, lw=0.8, color="0.4")
        dots = axes.scatter(
            *x[good].T, c=error[good], s=9, lw=0, alpha=1.0, vmin=0.0, vmax=LARGEST,
            cmap=theme.SEQUENTIAL,
        )  # fmt: skip
        axes.set_axis_off()
        axes.set_proj_type("ortho")
        extent = np.ptp(corners, axis=0)
        axes.set_box_aspect(extent, zoom=ZOOM * np.linalg.norm(extent) / extent[2])
        axes.view_init(elev=12.0, azim=-90.0)
        figure.text((k + 0.5) * WIDTH / wide, 0.95, name, ha="center", fontsize=10)
    bar = figure.add_axes((1.0 - 0.85 / figure.get_figwidth(), 0.2, 0.012, 0.6))
    figure.colorbar(dots, cax=bar, extend="max", label="position error (mm)")
    theme.save(figure, out, "real_bodies")


def _facing(positions: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Axes (3, 3), rows: the longest extent of points (n, 3) upright, the normal to the viewer."""
    toward = normal / np.linalg.norm(normal)
    centred = positions - positions.mean(axis=0)
    up = np.linalg.svd(centred - np.outer(centred @ toward, toward), full_matrices=False)[2][0]
    return np.stack([np.cross(-toward, up), -toward, up])


if __name__ == "__main__":
    sys.exit(main())
