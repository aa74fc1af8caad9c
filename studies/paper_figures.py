"""Figures 4 to 9 of Cannata, Denei, Mastrogiovanni (ICRA 2010), drawn from meshskin's own runs.

    python studies/paper_figures.py --out figures/ [--full]

Figures 4 and 5: the force over time and the estimates from ideal data, on the scene `sphere`.
Figures 6 to 8: a pose graph of displacements perturbed by N(0, 1 mm^2), every pose started at the
origin; first, middle and last iteration. Figure 9, 20 seeds a level (100 with --full), with the
paper's own claims:

left    as the paper draws it: noise on the poses, a start trilaterated by eq. 15, which takes
        readings as those of points (here they are: discs of 0.1 mm), and the mean error after 1,
        100 and 1000 iterations of a relaxation. Every level and seed has noise of its own.
right   a scaled demonstration: displacements with noise, a start that chains them, and the
        maximum-likelihood estimate. The noise of a seed is the same at every level, scaled, so that
        the ten levels are one number.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import paper_noise
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

import meshskin as ms
from meshskin.estimation import demonstration
from meshskin.estimation.calibrate import Estimation
from meshskin.estimation.uncertainty import metrics
from meshskin.report import curves, maps, theme
from meshskin.report.data import ReportData
from meshskin.simulation.response import controlled_force, force_response

POSE_NOISE = np.array([0.1, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0]) * 1e-3
"""Noise of the poses, m, of figure 9, left."""
POINT = 1e-4
"""Radius, m, of the taxels whose readings eq. 15 takes for those of points."""
LEVELS = np.array([0.5, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 12.0]) * 1e-3
"""Mean errors of the start, m, of figure 9, right."""


class Claim(NamedTuple):
    """A published improvement (fraction) for initial errors from `low` to `high` (m)."""

    low: float
    high: float
    improvement: float
    label: str


PAPER_CLAIMS = (
    Claim(0.5e-3, 3e-3, 0.2, "paper: 20 %"),
    Claim(3e-3, 6e-3, 0.5, "paper: up to 50 %"),
)
"""Cannata, Denei, Mastrogiovanni, ICRA 2010, section V."""


def main(arguments: list[str] | None = None) -> dict[str, float]:
    """Draw the figures; return the numbers that they show."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("figures"))
    parser.add_argument("--seeds", type=int, default=None, help="seeds a level of figure 9")
    parser.add_argument("--full", action="store_true", help="100 seeds a level")
    options = parser.parse_args(arguments)
    seeds = options.seeds or (100 if options.full else 20)

    scene = ms.Scene.load("sphere")
    recording = ms.simulate(scene)
    calibration = ms.calibrate(recording, belief=scene.belief())
    assert recording.motion is not None
    time, force, reference, phase = controlled_force(recording.motion)
    settling = force_response(time, force, reference, phase).settling
    theme.save(curves.force(time, force, reference, settling), options.out, "fig4")
    shown = demonstration.demonstrate(scene.skin.poses, scene.skin.ids, recording)
    data = ReportData(calibration, truth=scene.skin, demonstration=shown)
    assert data.iterations is not None
    theme.save(maps.estimates(data), options.out, "fig5")
    iterations = maps.iterations(data.iterations, data.plane)
    theme.save(iterations, options.out, "fig6-8")
    theme.save_panels(iterations, options.out, ("fig6", "fig7", "fig8"))

    pairs = demonstration.coactive_pairs(recording, scene.skin.ids)
    swept = paper_noise.noise_sweep(scene.skin.poses, pairs, LEVELS, seeds)
    initial, final = swept.initial.mean(axis=1), np.nanmean(swept.final, axis=1)
    noisy = pose_noise(scene, seeds)
    theme.save(figure_9(noisy, initial, swept.final), options.out, "fig9")

    ideal = metrics.summary_mm(metrics.position_errors(calibration, scene.skin))
    print(f"fig. 4: force {force[time > 0.3].mean():.4f} N for {scene.law.force_reference:g} N")
    print(f"fig. 5: mean error {ideal['mean']:.2g} mm from ideal data")
    print(f"fig. 8: mean error {1e3 * shown.mean_error:.3f} mm from 1 mm displacements")
    print(f"fig. 9, left: {seeds} seeds a level, noise on the poses; mean errors in mm")
    print("  noise   start" + "".join(f"  after {k:4d}" for k in paper_noise.ITERATIONS))
    for sigma, a, row in zip(noisy.sigmas, noisy.initial, noisy.relaxed, strict=True):
        after = "".join(f"{1e3 * x:12.3f}" for x in row.mean(axis=0))
        print(f"  {1e3 * sigma:5.2f}{1e3 * a.mean():8.3f}{after}")
    print(f"fig. 9, right: {seeds} seeds a level, {len(pairs)} displacements")
    print("  start (mm)   estimate (mm)   improvement   minima found")
    for a, b, row in zip(1e3 * initial, 1e3 * final, swept.final, strict=True):
        found = np.isfinite(row).mean()
        print(f"  {a:10.2f}   {b:13.3f}   {100 * (1 - b / a):9.1f} %   {100 * found:10.0f} %")
    return {
        "force_n": float(force[time > 0.3].mean()),
        "ideal_mm": ideal["mean"],
        "demonstration_mm": 1e3 * shown.mean_error,
        "least_improvement": float((1 - final / initial).min()),
        "minima": float(np.isfinite(swept.final).mean()),
        "pose_noise_start_mm": (1e3 * noisy.initial.mean(axis=1)).tolist(),
        "pose_noise_mm": (1e3 * noisy.relaxed.mean(axis=1)).tolist(),
    }


def pose_noise(scene: ms.Scene, seeds: int) -> paper_noise.NoisyPoses:
    """Errors over POSE_NOISE, from ideal readings of points."""
    scene = scene.with_(skin=ms.Skin(scene.skin.poses, scene.skin.ids, POINT))
    recording = ms.simulate(scene)
    data = Estimation(recording, scene.belief()).data
    pairs = demonstration.coactive_pairs(recording, scene.skin.ids)
    return paper_noise.noisy_poses(data, scene.skin.poses, pairs, POSE_NOISE.tolist(), seeds)


@theme.styled
def figure_9(noisy: paper_noise.NoisyPoses, initial: ArrayLike, final: ArrayLike) -> Figure:
    """Fig. 9: `after_iterations`, and beside it `initial_error`."""
    figure = theme.new_figure(12.4, 4.4)
    after_iterations(theme.add_axes(figure, 0.65, 0.6, 5.3, 3.45), noisy)
    initial_error(theme.add_axes(figure, 6.85, 0.6, 5.3, 3.45), initial, final)
    return figure


def after_iterations(axes: Axes, noisy: paper_noise.NoisyPoses) -> None:
    """Mean errors over those of the trilaterated start, after each number of iterations."""
    start, mean = 1e3 * noisy.initial.mean(axis=1), 1e3 * noisy.relaxed.mean(axis=1)
    limit = 1.04 * float(start.max())
    axes.plot([0, limit], [0, limit], color=theme.MUTED, lw=0.9, ls=":", label="no improvement")
    draw_claims(axes, PAPER_CLAIMS, limit)
    for colour, count, y in zip(theme.PALETTE, paper_noise.ITERATIONS, mean.T, strict=False):
        words = f"after {count} iteration{'s' if count > 1 else ''}"
        axes.plot(start, y, "o-", color=colour, ms=4, lw=1.4, label=words)
    axes.set(xlim=(0, limit), ylim=(0, 1.3 * limit))
    axes.set(xlabel="mean error of the trilaterated start (mm)", ylabel="mean error (mm)")
    axes.set_title("As in the paper: noise on the poses, start by eq. 15")
    axes.legend(loc="upper left")


def draw_claims(axes: Axes, claims: Sequence[Claim], limit: float = np.inf) -> None:
    """Draw published improvements over mean errors of the start up to `limit`, mm."""
    for claim, style in zip(claims, ("-", "--", "-.") * len(claims), strict=False):
        span = np.minimum(np.array([claim.low, claim.high]) * 1e3, limit)
        y = (1 - claim.improvement) * span
        axes.plot(span, y, color=theme.WARNING, lw=1.8, ls=style, label=claim.label)


def initial_error(
    axes: Axes, initial: ArrayLike, final: ArrayLike, claims: Sequence[Claim] = PAPER_CLAIMS
) -> None:
    """Mean error of the maximum-likelihood estimate over that of the start.

    initial (k,): mean error of the start, m; final (k, seeds): mean error reached, m, NaN where a
    run failed; claims: published improvements, for comparison.
    """
    x = np.asarray(initial, dtype=float) * 1e3
    y = np.asarray(final, dtype=float).reshape(len(x), -1) * 1e3
    low, middle, high = np.nanpercentile(y, [10, 50, 90], axis=1)
    order = np.argsort(x)
    limit = 1.04 * float(x.max())
    axes.plot([0, limit], [0, limit], color=theme.MUTED, lw=0.9, ls=":", label="no improvement")
    draw_claims(axes, claims)
    axes.fill_between(
        x[order],
        low[order],
        high[order],
        color=theme.ESTIMATE,
        alpha=0.2,
        lw=0,
        label=f"10–90 % of {y.shape[1]} seeds",
    )
    axes.plot(x[order], middle[order], "o-", color=theme.ESTIMATE, ms=4, lw=1.4, label="median")
    axes.set(xlim=(0, limit), ylim=(0, 1.04 * max(limit, float(np.nanmax(high)))))
    axes.set(
        xlabel="mean error of the start (mm)",
        ylabel="mean error of the maximum-likelihood estimate (mm)",
    )
    axes.set_title("Scaled demonstration: noise on displacements, chained start")
    axes.legend(loc="upper left")


if __name__ == "__main__":
    main()
