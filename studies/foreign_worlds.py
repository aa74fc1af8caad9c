"""Recordings by other people's physics: the error of each method, and whether its sigma holds.

    python studies/foreign_worlds.py [--worlds NAMES] [--seeds 3] [--full] [--out DIR]

The recordings are made by studies/worlds, which shares no contact model with meshskin: closed forms
with many electronics, among them barometers, capacitors and magnets in rubber, a rubber layer by
finite elements (scikit-fem), pins on springs (MuJoCo), a wrinkled and a yielding half-space
(tamaas), a compliant sphere by hydroelastic contact (Drake); pip install ".[worlds]" brings these
solvers. On a sphere of 0.1 m are 97 taxels; 985 contacts follow a spiral, forces of 3 N vary by
5 %, and the noise is 1 %, a level that the calibration does not know. The world "edge" is a thin
layer on a prism with 25 taxels about one of its edges, tapped 150 times.

Printed for each world are rms errors in mm: of the pressure-weighted mean of contact points (the
baseline), three chosen circles, the joint estimate with Hertz' contact, the same with gain and
offset declared unknown, the joint estimate by default, and with the learned contact model; the
bound of the world's noise for who knows all but the places; the rms of the stated standard
deviations over the rms error, the mean normalized squared error (NEES, 2 by theory), and processor
seconds. A "!" follows errors above the baseline's, and
"-k" precedes those of methods that leave k taxels without a place. "refused": an error was raised.

--full: 20 seeds. Written are foreign_worlds.csv and a figure.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from time import process_time
from typing import TYPE_CHECKING, Any

import numpy as np
from worlds import sphere
from worlds.bound import bound
from worlds.catalogue import SOLVERS, names, world
from worlds.edge import Edge, EdgeSample
from worlds.world import Sample, World, record

import meshskin as ms
from meshskin.core.atomic_io import atomic
from meshskin.core.errors import CalibrationError, MeshskinError
from meshskin.estimation.centroid import centroids
from meshskin.report import theme
from meshskin.report.precision import decimal_ticks

if TYPE_CHECKING:
    from matplotlib.figure import Figure

METHODS = {
    "centroid": "centroid",
    "three_circles": "three chosen circles",
    "hertz": "joint, Hertz",
    "hertz_gain": "joint, Hertz, gain, offset",
    "joint": "joint",
    "learned": "joint, learned",
}
"""Columns in the order of the table, in words."""
BASELINE = "centroid"


def belief(sample: Sample | EdgeSample, body: ms.Body, **options: Any) -> ms.Belief:
    """What the robot's owner knows: shapes, a nominal material, and the level of the threshold."""
    return ms.Belief(
        body=body,
        indenter=ms.Indenter.sphere(sphere.INDENTER_RADIUS),
        material=ms.Material(0.2e6, 0.49),
        taxel_ids=np.arange(len(sample.positions)),
        disc_radius=sphere.DISC_RADIUS,
        **{"threshold": sample.threshold, **options},
    )


@dataclass(frozen=True)
class Estimate:
    """What a method says of the places."""

    positions: np.ndarray
    """(n, 3), m; NaN where undetermined."""
    sigma: float
    """Rms stated standard deviation, m."""
    nees: float = float("nan")
    """Mean normalized squared error: 2 where the covariances hold."""


def centroid(sample: Sample | EdgeSample, body: ms.Body) -> Estimate:
    """Weighted means of contact points on the body, of raw readings, too."""
    r, n = sample.recording, len(sample.positions)
    points = r.points[r.reading_contact]
    mean, _, covariance = centroids(points, r.reading_taxel, r.pressure, n)
    sigma = np.sqrt(np.mean(np.trace(covariance, axis1=1, axis2=2)))
    return Estimate(body.closest(mean).point, float(sigma))


def estimate(sample: Sample | EdgeSample, body: ms.Body, method: str) -> Estimate:
    """The estimate by a method.

    Raises MeshskinError where the method refuses the recording.
    """
    if method == BASELINE:
        return centroid(sample, body)
    options: dict[str, Any] = {}
    if method.startswith("hertz"):
        options["contact"] = "hertz"
    if method == "hertz_gain":
        options["unknown"] = ("modulus", "gain", "offset")
    if method == "learned":
        options |= {"contact": "learned", "readings": "raw"}
    by = "three_circles" if method == "three_circles" else "joint"
    found = ms.calibrate(sample.recording, belief(sample, body, **options), method=by)
    good = np.isfinite(found.positions[:, 0])
    if not good.any():
        raise CalibrationError("no taxel is determined", value=found.reasons[0])
    sigma = float(np.sqrt(np.mean(found.position_sigma[good] ** 2)))
    off = np.einsum(
        "nji,nj->ni", found.poses[good, :3, :3], (found.positions - sample.positions)[good]
    )
    solved = np.linalg.solve(found.covariances[good, :2, :2], off[:, :2, None])[:, :, 0]
    return Estimate(found.positions, sigma, float(np.mean(np.sum(off[:, :2] * solved, axis=1))))


def sampled(made: World | Edge, seed: int) -> tuple[Sample | EdgeSample, float]:
    """A recording, and the bound of its noise, m; NaN where unknown."""
    if isinstance(made, Edge):
        return made.record(seed), float("nan")
    sample = record(made, seed)
    return sample, bound(made, sample)


def measure(
    made: World | Edge, seed: int, body: ms.Body, methods: list[str], reasons: dict[str, str]
) -> dict[str, float]:
    """Errors and sigmas, mm, seconds, and taxels without a place, of all methods on one recording.

    reasons: gets why a method refuses it.
    """
    sample, limit = sampled(made, seed)
    readings = np.bincount(sample.recording.reading_taxel, minlength=len(sample.positions))
    row = {"bound_mm": 1e3 * limit, "readings": float(np.median(readings))}
    for method in methods:
        begin = process_time()
        try:
            found = estimate(sample, body, method)
        except MeshskinError as error:
            reasons[method] = str(error).splitlines()[0]
            found = Estimate(np.full_like(sample.positions, np.nan), np.nan)
        off = np.linalg.norm(found.positions - sample.positions, axis=1)
        good = np.isfinite(off)
        rms = float(np.sqrt(np.mean(off[good] ** 2))) if good.any() else np.nan
        row |= {
            f"{method}_mm": 1e3 * rms,
            f"{method}_sigma_mm": 1e3 * found.sigma,
            f"{method}_nees": found.nees,
            f"{method}_lost": float(np.sum(~good)),
            f"{method}_s": process_time() - begin,
        }
    return row


def summary(rows: list[dict[str, float]]) -> dict[str, float]:
    """Root mean squares over the seeds of errors, sigmas and bounds; means of the rest.

    A method that refuses some seeds counts as refusing all: NaN.
    """
    out = {}
    for name in rows[0]:
        values = np.array([row[name] for row in rows])
        square = name.endswith("_mm")
        out[name] = float(np.sqrt(np.mean(values**2)) if square else np.mean(values))
    return out


def print_head(methods: list[str], seeds: int) -> None:
    """The head of the table."""
    print(
        "rms errors in mm, stated over true error and NEES in brackets, processor seconds; "
        f"{seeds} seeds"
    )
    cells = "".join(f"{METHODS[method]:>34}" for method in methods)
    print(f"{'world':20}{'readings':>9}{'bound':>9}{cells}")


def print_row(name: str, row: Mapping[str, float], methods: list[str]) -> None:
    """One world."""
    cells = "".join(f"{cell(row, method):>34}" for method in methods)
    shown = f"{row['bound_mm']:.4f}" if np.isfinite(row["bound_mm"]) else "-"
    print(f"{name:20}{row['readings']:9.0f}{shown:>9}{cells}", flush=True)


def cell(row: Mapping[str, float], method: str) -> str:
    """A method's entry: error, whether it is above the baseline's, ratio, seconds."""
    error = row[f"{method}_mm"]
    if not np.isfinite(error):
        return "refused"
    sigma = row[f"{method}_sigma_mm"] / error
    worse = "!" if error > row[f"{BASELINE}_mm"] else " "
    nees = row[f"{method}_nees"]
    ratio = f"({sigma:.2f}{f', {nees:.3g}' if np.isfinite(nees) else ''})"
    ratio = ratio if np.isfinite(sigma) else ""
    lost = f"-{row[f'{method}_lost']:.3g}" if row[f"{method}_lost"] else ""
    return f"{lost:>5}{error:8.4f}{worse}{ratio:>13}{row[f'{method}_s']:6.2f}"


def worse_than_baseline(found: Mapping[str, Mapping[str, float]]) -> list[str]:
    """Every estimate whose error is above the baseline's, in words."""
    return [
        f"{name}: {words} {row[f'{method}_mm'] / row[f'{BASELINE}_mm']:.1f} times the centroid"
        for name, row in found.items()
        for method, words in METHODS.items()
        if row.get(f"{method}_mm", np.nan) > row[f"{BASELINE}_mm"]
    ]


def write_csv(found: Mapping[str, Mapping[str, float]], path: Path) -> None:
    """The rows with all their numbers."""
    with atomic(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        names = list(next(iter(found.values())))
        writer.writerow(["world", *names])
        writer.writerows([world, *(row[name] for name in names)] for world, row in found.items())


@theme.styled
def draw(found: Mapping[str, Mapping[str, float]]) -> Figure:
    """Errors over the worlds, and stated over true error."""
    figure = theme.new_figure(11.0, 0.32 * len(found) + 1.6)
    errors, ratios = figure.subplots(1, 2, sharey=True)
    y = np.arange(len(found))
    for method, words in METHODS.items():
        colour = theme.method_colour(method)
        error = np.array([row.get(f"{method}_mm", np.nan) for row in found.values()])
        sigma = np.array([row.get(f"{method}_sigma_mm", np.nan) for row in found.values()])
        errors.plot(error, y, "o", ms=5, color=colour, label=words)
        ratios.plot(sigma / error, y, "o", ms=5, color=colour)
    limit = [row["bound_mm"] for row in found.values()]
    errors.plot(limit, y, "|", ms=12, color=theme.INK, label="bound of the noise")
    errors.set(xscale="log", xlabel="rms error (mm)")
    ratios.set(xscale="log", xlabel="stated over true error")
    errors.set_yticks(y, list(found))
    errors.invert_yaxis()
    ratios.axvspan(0.8, 1.25, color=theme.FAINT)
    decimal_ticks(errors)
    decimal_ticks(ratios)
    figure.tight_layout(rect=(0.0, 0.0, 1.0, 1.0 - 0.3 / figure.get_figheight()))
    figure.legend(loc="upper left", ncols=len(METHODS) + 1, fontsize=8)
    return figure


def main(arguments: list[str] | None = None) -> dict[str, dict[str, float]]:
    """Run the worlds; return their rows."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--worlds", nargs="+", choices=names(), default=names())
    parser.add_argument("--methods", nargs="+", choices=list(METHODS), default=list(METHODS))
    parser.add_argument("--seeds", type=int, default=None)
    parser.add_argument("--full", action="store_true", help="20 seeds")
    parser.add_argument("--out", type=Path, default=Path("figures"))
    options = parser.parse_args(arguments)
    seeds = options.seeds or (20 if options.full else 3)
    methods = [m for m in METHODS if m == BASELINE or m in options.methods]
    cap, found = ms.Body.sphere(sphere.RADIUS), {}
    print_head(methods, seeds)
    refused: dict[str, str] = {}
    for name in options.worlds:
        if (solver := SOLVERS.get(name)) and find_spec(solver) is None:
            print(f'{name:20}left out: {solver} is missing; pip install ".[worlds]"')
            continue
        reasons: dict[str, str] = {}
        made = world(name)
        body = made.body if isinstance(made, Edge) else cap
        rows = [measure(made, seed, body, methods, reasons) for seed in range(seeds)]
        found[name] = summary(rows)
        print_row(name, found[name], methods)
        refused |= {f"{name}: {METHODS[method]} refused": why for method, why in reasons.items()}
    print(*(f"{what}: {why}" for what, why in refused.items()), sep="\n")
    print(*worse_than_baseline(found), sep="\n")
    write_csv(found, options.out / "foreign_worlds.csv")
    theme.save(draw(found), options.out, "foreign_worlds")
    return found


if __name__ == "__main__":
    main()
