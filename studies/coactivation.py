"""Layouts from co-activation alone: a real torso of iCub, and every shipped scene.

    python studies/coactivation.py --out figures/ [--data DIR] [--levels] [--scenes NAME ...]

DIR (by default MESHSKIN_DATA) holds icub_torso_touches: 20,242 binary frames of a thumb on 440
taxels, and their published layout in the plane, which only scores. Distances are root mean square,
mm, after a similarity fit: over all taxels, over those of modules whose turn agrees with the
published one, the stated sigma of the latter, and the share of them within two sigmas. Two modules
of 44, 256 and 260, are turned by 120 degrees against the published layout. Their taxels alone make
3.0 mm of the distance over all of them, whatever the others do. Which of the two is right is tested
by touches that made neither: the layout is that of the first half of the frames, and the stress of
the turned modules' distances from the others in the second half is compared for the three turns.
The scenes are simulated with seed 1; their layouts are fitted to the true positions by a rigid
motion, or its mirror image: in the plane, on the body, and on the body with the middle of the skin
known. The contact points are not used. --levels compares four levels of graded readings with eight.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import meshskin as ms
from meshskin.estimation.layout import coactivity, stress
from meshskin.estimation.layout.alignment import aligned, root_mean_square
from meshskin.estimation.layout.placement import rotated
from meshskin.report import theme
from meshskin.scene.shipped_scenes import scenes
from meshskin.skin import slots

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SPACING = 5e-3
TURNED = 60.0
"""Degrees from which a module's turn differs: the nearest wrong one is 120 away."""


def frames_of(recording: ms.Recording) -> np.ndarray:
    """Pressures (frames, taxels) of a recording, 0 where silent."""
    ids = np.array(recording.metadata["taxel_ids"])
    time, taxel, pressure = (
        recording.readings[name].to_numpy() for name in ("time", "taxel", "pressure")
    )
    times, row = np.unique(time, return_inverse=True)
    frames = np.zeros((len(times), len(ids)))
    frames[row, np.searchsorted(ids, taxel)] = pressure
    return frames


def of_scenes(names: list[str]) -> dict[str, dict[str, float]]:
    """Distances, mm, of the layouts of every shipped scene."""
    found = {}
    for name in names:
        scene = ms.Scene.load(name)
        frames, true = frames_of(ms.simulate(scene, seed=1)), scene.skin.positions
        given: dict[str, dict[str, Any]] = {
            "plane": {},
            "body": {"body": scene.body},
            "body, middle known": {"body": scene.body, "centre": true.mean(axis=0)},
        }
        row = {}
        for kind, knowledge in given.items():
            layout = ms.layout(frames, spacing=SPACING, **knowledge)
            row[kind] = 1e3 * root_mean_square(aligned(layout.positions, true) - true)
            row[f"{kind}: sigma"] = 1e3 * float(np.sqrt(np.mean(layout.sigma**2)))
        found[name] = row
    return found


def turned(ids: np.ndarray, points: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Taxels (n,) bool of modules that are turned against `true` (n, 2) by more than TURNED."""
    wrong = np.zeros(len(ids), dtype=bool)
    for module in np.unique(ids // slots.PER_MODULE):
        rows = ids // slots.PER_MODULE == module
        a, b = points[rows] - points[rows].mean(axis=0), true[rows] - true[rows].mean(axis=0)
        cross = np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
        wrong[rows] = abs(np.rad2deg(np.arctan2(cross, np.sum(a * b)))) > TURNED
    return wrong


def stress_by_turn(frames: np.ndarray, ids: np.ndarray, modules: np.ndarray) -> np.ndarray:
    """Mean stress (m, 3) of the near pairs of each of `modules` (m,) with all others in the second
    half of the frames, in the layout of the first half, and with the module turned by 120 and 240
    degrees."""
    half, module = len(frames) // 2, ids // slots.PER_MODULE
    layout = ms.layout(frames[:half], ids, module_slots=slots.OFFSETS, tiled=True)
    points = layout.positions
    near = coactivity.near_lengths(coactivity.distinct_levels(frames[half:])).toarray()
    near[~(layout.reasons == "")] = 0.0
    weight = np.where(near > 0, stress.weights(near), 0.0)
    along = stress.distances(np.nan_to_num(points))
    unit = np.sum(weight * near * along) / np.sum(weight * near**2)
    found = np.zeros((len(modules), 3))
    for row, k in enumerate(modules):
        own = module == k
        centre = points[ids == slots.PER_MODULE * k + slots.CENTRE]
        for turn in range(3):
            moved = centre + rotated(points[own] - centre, 2 * np.pi * turn / 3)
            apart = np.linalg.norm(moved[:, None] - points[~own], axis=2)
            pairs = weight[np.ix_(own, ~own)], near[np.ix_(own, ~own)]
            square = pairs[0] * (apart / unit - pairs[1]) ** 2
            found[row, turn] = np.nansum(square) / np.count_nonzero(pairs[0])
    return found


def of_torso(folder: Path, out: Path | None) -> dict[str, dict[str, float]]:
    """Distances, mm, of layouts of iCub's torso from the published one."""
    from scipy.io import loadmat

    published = loadmat(folder / "TorsoTaxPosCut.mat")
    frames = loadmat(folder / "torso1exper1thumbACut.mat")["TrainTorso1expA"]
    ids = published["TorsoNumbTaxCut"].ravel().astype(int) - 1
    true = 1e-3 * published["TorsoTaxPosCut"][:2].T
    given: dict[str, dict[str, Any]] = {
        "taxels alone": {"spacing": 6.5e-3},
        "rigid modules": {"module_slots": slots.OFFSETS},
        "modules edge to edge": {"module_slots": slots.OFFSETS, "tiled": True},
    }
    layouts = {kind: ms.layout(frames, ids, **known) for kind, known in given.items()}
    fitted = {k: aligned(layout.positions, true, scale=True) for k, layout in layouts.items()}
    agrees = ~turned(ids, fitted["rigid modules"], true)
    found = {}
    for kind, layout in layouts.items():
        kept = aligned(layout.positions[agrees], true[agrees], scale=True) - true[agrees]
        error = np.linalg.norm(kept, axis=1)
        found[kind] = {
            "all": 1e3 * root_mean_square(fitted[kind] - true),
            "as turned": 1e3 * root_mean_square(kept),
            "sigma": 1e3 * float(np.sqrt(np.mean(layout.sigma[agrees] ** 2))),
            "within two sigmas": float(np.mean(error < 2 * layout.sigma[agrees])),
        }
    modules = np.unique(ids[~agrees] // slots.PER_MODULE)
    alone = np.where(agrees[:, None], 0.0, fitted["modules edge to edge"] - true)
    print(
        f"turned against the published layout: modules {', '.join(map(str, modules))}, which alone "
        f"make {1e3 * root_mean_square(alone):.2f} mm over all taxels"
    )
    for k, (as_found, *others) in zip(modules, stress_by_turn(frames, ids, modules), strict=True):
        further = ", ".join(f"{value:.3f}" for value in others)
        print(f"module {k}: stress {as_found:.3f}, turned by 120 and 240 degrees {further}")
    if out:
        theme.save(draw(fitted, true, agrees), out, "coactivation_torso")
    return found


@theme.styled
def draw(fitted: dict[str, np.ndarray], true: np.ndarray, agrees: np.ndarray) -> Figure:
    """Arrows from the published positions to those of each layout."""
    figure = theme.new_figure(3.0 * len(fitted) + 0.3, 4.3)
    for k, (kind, points) in enumerate(fitted.items()):
        axis = theme.add_axes(figure, 0.6 + 3.0 * k, 0.5, 2.5, 3.4)
        off = 1e3 * (points - true)
        for rows, colour in ((agrees, theme.PALETTE[0]), (~agrees, theme.WARNING)):
            axis.quiver(
                *(1e3 * true[rows].T), *off[rows].T, color=colour,
                angles="xy", scale_units="xy", scale=1, width=3e-3,
            )  # fmt: skip
        axis.set(title=f"{kind}: {root_mean_square(off):.2f} mm", xlabel="mm", aspect="equal")
    return figure


def table(title: str, rows: dict[str, dict[str, float]]) -> None:
    """Print rows of numbers under the names of their columns."""
    columns = list(next(iter(rows.values())))
    print(f"\n{title:24}" + "".join(f"{c:>26}" for c in columns))
    for name, row in rows.items():
        print(f"{name:24}" + "".join(f"{row[c]:26.2f}" for c in columns))


def with_levels(levels: int, run: Callable[[], dict[str, dict[str, float]]]) -> Any:
    """The result of `run` with another number of levels."""
    kept, coactivity.LEVELS = coactivity.LEVELS, levels
    try:
        return run()
    finally:
        coactivity.LEVELS = kept


def main(arguments: list[str] | None = None) -> dict[str, dict[str, dict[str, float]]]:
    """Run the study and return its tables."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, help="folder of the figure")
    parser.add_argument("--data", type=Path, default=os.environ.get("MESHSKIN_DATA", "data"))
    parser.add_argument("--levels", action="store_true")
    parser.add_argument("--scenes", nargs="*", choices=scenes(), default=list(scenes()))
    options = parser.parse_args(arguments)
    found = {"scenes": of_scenes(options.scenes)}
    if options.scenes:
        table("scene (mm)", found["scenes"])
    if options.levels and options.scenes:
        found["eight levels"] = with_levels(8, lambda: of_scenes(options.scenes))
        table("eight levels (mm)", found["eight levels"])
    folder = options.data / "icub_torso_touches"
    if folder.is_dir():
        found["torso"] = of_torso(folder, options.out)
        table("torso of iCub (mm)", found["torso"])
    else:
        print(f"no torso: {folder} is not there")
    return found


if __name__ == "__main__":
    main()
