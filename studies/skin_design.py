"""The error as a function of the design of the skin: spacing, taxel radius, layer, stiffness.

    python studies/skin_design.py --out figures/ [--seeds 2] [--json FILE] [--full]

One property of the paper's sphere is changed at a time. The sphere is moved without an arm along
the same lanes, with the same transducers: their noise is 1 % of the peak pressure of the original
skin, in Pa. The study prints and draws the mean error of the joint estimate with its bound, that of
the pose graph, whose displacements need neighbours under one patch (there are none if no two taxels
are pressed together), and, for thin layers, that of a calibration that assumes a thick layer.
--full: 5 seeds and twice the values.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import meshskin as ms
from meshskin.core.atomic_io import write_json
from meshskin.core.errors import MeshskinError
from meshskin.effects.gaussian_noise import GaussianNoise
from meshskin.estimation.uncertainty import metrics
from meshskin.geometry.region import Cap
from meshskin.report import precision, theme

if TYPE_CHECKING:
    from matplotlib.artist import Artist

COUNT = 40
"""Taxels of every skin."""
VALUES = {
    "spacing_mm": (4.2, 5.0, 6.0, 8.0, 10.0),
    "disc_radius_mm": (0.5, 1.0, 1.5, 2.0, 2.4),
    "thickness_mm": (3.0, 4.0, 6.0, 10.0, 20.0),
    "young_kpa": (100.0, 200.0, 400.0, 800.0, 1600.0),
}
"""Property -> its values; the thickness has no original one: that layer has no end."""
LABELS = {
    "spacing_mm": "spacing of the taxels (mm)",
    "disc_radius_mm": "radius of a taxel (mm)",
    "thickness_mm": "thickness of the layer (mm)",
    "young_kpa": "Young's modulus (kPa)",
}


def main(arguments: list[str] | None = None) -> dict[str, list[dict[str, float]]]:
    """Run the study; return the rows of each property."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("figures"))
    parser.add_argument("--seeds", type=int, default=None)
    parser.add_argument("--only", nargs="*", default=None, metavar="PROPERTY")
    parser.add_argument("--full", action="store_true", help="5 seeds, twice the values")
    parser.add_argument("--json", type=Path, default=None)
    options = parser.parse_args(arguments)
    seeds = range(options.seeds or (5 if options.full else 2))

    base = ms.Scene.load("sphere_noisy")
    base = base.with_(loop=replace(base.loop, mode="quasi_static"), effects=())
    sigma = 0.01 * base.patch.peak
    rows = {}
    for name in options.only or VALUES:
        values = with_geometric_means(VALUES[name]) if options.full else VALUES[name]
        rows[name] = [measure_design(base, sigma, name, value, seeds) for value in values]
        print_rows(name, rows[name], seeds)
    theme.save(draw_curves(rows), options.out, "skin_design")
    if options.json:
        write_json(options.json, rows)
    return rows


def with_geometric_means(values: tuple[float, ...]) -> tuple[float, ...]:
    """The values and their geometric means."""
    more = [float(np.sqrt(a * b)) for a, b in pairwise(values)]
    return tuple(sorted([*values, *more]))


def designed_scene(base: ms.Scene, sigma: float, **design: float) -> ms.Scene:
    """The scene with a skin of this design and transducers with noise `sigma`, Pa."""
    disc = 1e-3 * design.get("disc_radius_mm", 2.0)
    skin = ms.Skin.cover(
        base.body,
        spacing=1e-3 * design.get("spacing_mm", 5.0),
        count=COUNT,
        region=Cap(direction=(0.0, 0.0, -1.0)),
        disc_radius=disc,
    )
    thickness = design.get("thickness_mm")
    material = replace(
        base.material,
        young=1e3 * design.get("young_kpa", 200.0),
        thickness=None if thickness is None else 1e-3 * thickness,
    )
    contact = "hertz" if thickness is None else "layered"
    made = base.with_(skin=skin, material=material, contact=contact)
    noise = GaussianNoise(sigma_relative=sigma / made.patch.peak)
    readout = replace(base.readout, threshold_relative=5 * noise.sigma_relative)
    return made.with_(effects=(noise,), readout=readout)


def measure_design(
    base: ms.Scene, sigma: float, name: str, value: float, seeds: range
) -> dict[str, float]:
    """Errors, mm, of one design, over seeds."""
    scene = designed_scene(base, sigma, **{name: value})
    belief = scene.belief()
    names = ("joint", "posegraph", "centroid", "thick", "bound")
    found: dict[str, list[float]] = {name: [] for name in names}
    for seed in seeds:
        recording = ms.simulate(scene, seed)
        for method in ("joint", "posegraph", "centroid"):
            found[method].append(error(scene, recording, belief, method))
        if name == "thickness_mm":
            material = replace(belief.material, thickness=None)
            thick = replace(belief, contact="hertz", material=material)
            found["thick"].append(error(scene, recording, thick, "joint"))
        found["bound"].append(1e3 * metrics.cramer_rao(recording, belief, scene.skin).mean)
    means = {f"{key}_mm": float(np.mean(values)) for key, values in found.items() if values}
    patch = {"patch_mm": 1e3 * float(scene.patch.semi_axes[0]), "peak_kpa": 1e-3 * scene.patch.peak}
    return {name: value, **means, **patch}


def error(scene: ms.Scene, recording: ms.Recording, belief: ms.Belief, method: str) -> float:
    """Mean error, mm; NaN where the method gives nothing."""
    try:
        calibration = ms.calibrate(recording, belief, method=method)
        off = metrics.position_errors(calibration, scene.skin, method.startswith("posegraph"))
    except MeshskinError:
        return float("nan")
    return 1e3 * float(np.nanmean(off))


def print_rows(name: str, rows: list[dict[str, float]], seeds: range) -> None:
    """Print the rows of a property."""
    print(f"{LABELS[name]}, {len(seeds)} seeds: mean errors in mm")
    print(f"  {'value':>8}{'patch mm':>10}{'joint':>10}{'bound':>10}{'pose graph':>12}"
          f"{'centroid':>10}"
          + (f"{'as if thick':>13}" if "thick_mm" in rows[0] else ""))  # fmt: skip
    for row in rows:
        line = f"  {row[name]:8.4g}{row['patch_mm']:10.2f}{row['joint_mm']:10.4f}"
        line += f"{row['bound_mm']:10.4f}{row['posegraph_mm']:12.4f}{row['centroid_mm']:10.4f}"
        print(line + (f"{row['thick_mm']:13.4f}" if "thick_mm" in row else ""))


@theme.styled
def draw_curves(rows: dict[str, list[dict[str, float]]]) -> Any:
    """A panel a property: error against its value."""
    lines = (len(rows) + 1) // 2
    figure = theme.new_figure(9.0, 0.6 + 2.6 * lines)
    for k, (name, found) in enumerate(rows.items()):
        left, bottom = (0.8, 5.2)[k % 2], 0.95 + 2.6 * (lines - 1 - k // 2)
        axes = theme.add_axes(figure, left, bottom, 3.6, 2.05)
        x = [row[name] for row in found]
        for key, label, style in (
            ("joint_mm", "joint maximum likelihood", {"marker": "o", "color": theme.ESTIMATE}),
            ("posegraph_mm", "pose graph",
             {"marker": "s", "color": theme.method_colour("posegraph")}),
            ("centroid_mm", "centroid", {"marker": "v", "color": theme.method_colour("centroid")}),
            ("thick_mm", "joint, believing the layer thick",
             {"marker": "^", "color": theme.WARNING}),
            ("bound_mm", "Cramér-Rao expectation", {"ls": "--", "color": theme.INK, "lw": 1.0}),
        ):  # fmt: skip
            if key in found[0]:
                axes.plot(x, [row[key] for row in found], label=label, ms=5, **style)
        axes.set(xscale="log", yscale="log", xlabel=LABELS[name])
        for row in found:
            if np.isnan(row["posegraph_mm"]):
                axes.annotate(
                    "no pose graph",
                    (row[name], 0.97),
                    xycoords=("data", "axes fraction"),
                    ha="center",
                    va="top",
                    fontsize=8,
                    color=theme.method_colour("posegraph"),
                )
        if left < 1:
            axes.set_ylabel("mean error (mm)")
    limits = np.array([axes.get_ylim() for axes in figure.axes])
    handles: dict[str, Artist] = {}
    for name, axes in zip(rows, figure.axes, strict=True):
        axes.set_ylim(limits[:, 0].min(), limits[:, 1].max())
        precision.decimal_ticks(axes)
        axes.set_xticks(VALUES[name], [f"{value:g}" for value in VALUES[name]])
        axes.set_xticks([], minor=True)
        handles |= dict(zip(*axes.get_legend_handles_labels()[::-1], strict=True))
    figure.legend(handles.values(), handles.keys(), loc="lower center", ncols=len(handles))
    return figure


if __name__ == "__main__":
    main()
