"""What a calibration says of logs with ordinary mistakes: error, stated sigma and verdict.

    python studies/wrong_logs.py --out figures/ [--contact hertz] [--unknown-noise]

`sphere_noisy` is pressed with 2.5 to 3.5 N at 800 places near its taxels, in lanes. Each log has
one mistake. It is calibrated by default, that is, with a learned response where the readings
contradict the contact model, or with --contact hertz; with --unknown-noise the belief has no noise.
Printed, and written to wrong_logs.csv, are the rms error over the taxels that got a place, the
median of the stated standard deviations in space, mm, whether the response was learned, the
verdict and its first reason, and processor seconds. Errors and deviations are drawn.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
import pyarrow as pa
from dots import dots

import meshskin as ms
from meshskin.core.atomic_io import atomic
from meshskin.core.errors import MeshskinError
from meshskin.report import theme

CONTACTS, FORCES = 800, (2.5, 3.5)
Log = Callable[[ms.Recording], ms.Recording]


def press(scene: ms.Scene, seed: int) -> ms.Recording:
    """A sound log without metadata: places within 5 mm of the taxels, lanes 2 mm apart."""
    rng, skin = np.random.default_rng(seed), scene.skin
    near = skin.positions[rng.integers(len(skin), size=CONTACTS)]
    points = scene.body.closest(near + rng.uniform(-5e-3, 5e-3, (CONTACTS, 3))).point
    lane = np.floor(points[:, 0] / 2e-3).astype(int)
    order = np.lexsort((points[:, 1] * np.where(lane % 2, 1, -1), lane))
    force = rng.uniform(*FORCES, CONTACTS)
    made = ms.press(scene, points[order], force=force, seed=seed)
    return ms.Recording(made.contacts, made.readings, {})


def scaled(factor: float) -> Log:
    """Pressures times a factor."""
    return lambda log: log.with_columns(pressure=factor * log.pressure)


def moved(outward: float = 0.0, aside: float = 0.0) -> Log:
    """Contact points moved along the normals and along x, m."""
    x = np.array([1.0, 0.0, 0.0])
    return lambda log: log.with_columns(points=log.points + outward * log.normals + aside * x)


def rescaled(factor: float) -> Log:
    """Contact points scaled about their middle."""

    def made(log: ms.Recording) -> ms.Recording:
        middle = log.points.mean(axis=0)
        return log.with_columns(points=middle + factor * (log.points - middle))

    return made


def mounted_anew(aside: float) -> Log:
    """Contact points of the second half moved along x, m."""

    def made(log: ms.Recording) -> ms.Recording:
        late = np.arange(len(log.points)) >= len(log.points) // 2
        return log.with_columns(points=log.points + np.outer(late, [aside, 0.0, 0.0]))

    return made


def late(frames: int) -> Log:
    """Readings some frames too late; those of the last contacts are lost."""

    def made(log: ms.Recording) -> ms.Recording:
        row = log.reading_contact + frames
        kept = row < len(log.time)
        table = log.readings.filter(pa.array(kept))
        time = pa.array(log.time[row[kept]])
        table = table.set_column(table.column_names.index("time"), "time", time)
        return ms.Recording(log.contacts, table, {})

    return made


def corrupt(log: ms.Recording) -> ms.Recording:
    """One reading at 38 times the largest."""
    pressure = log.pressure.copy()
    pressure[len(pressure) // 2] = 38 * pressure.max()
    return log.with_columns(pressure=pressure)


LOGS: dict[str, Log] = {
    "sound": lambda log: log,
    "pressures 2 times too large": scaled(2.0),
    "pressures 3 times too large": scaled(3.0),
    "pressures 2 times too small": scaled(0.5),
    "pressures 3 times too small": scaled(1 / 3),
    "readings 1 frame late": late(1),
    "readings 3 frames late": late(3),
    "contact points 6 mm off the surface": moved(outward=6e-3),
    "contact points 1 mm aside": moved(aside=1e-3),
    "contact points times 1.01": rescaled(1.01),
    "body mounted anew, 0.5 mm aside": mounted_anew(0.5e-3),
    "all pressures equal": lambda log: log.with_columns(pressure=np.full(len(log.pressure), 2e4)),
    "one reading at 38 times the largest": corrupt,
}
"""Logs with one mistake each."""


BELIEFS: dict[str, dict[str, Any]] = {
    "body 1 % too large": {"body": ms.Body.sphere(0.101)},
    "nominal E* 30 times too large": {"material": ms.Material(30 * 0.2e6, 0.49)},
}
"""Wrong beliefs about a sound log."""


def row(scene: ms.Scene, name: str, log: ms.Recording, belief: ms.Belief) -> dict[str, Any]:
    """What the calibration of a log says, and how far it is off."""
    begin, out = process_time(), {"log": name}
    try:
        found = ms.calibrate(log, belief)
    except MeshskinError as refusal:
        return out | {"verdict": "refused", "reason": str(refusal)}
    error = np.linalg.norm(found.positions - scene.skin.positions, axis=1)
    assert found.verdict is not None
    return out | {
        "error_mm": 1e3 * float(np.sqrt(np.nanmean(error**2))),
        "sigma_mm": 1e3 * float(np.nanmedian(found.position_sigma)),
        "learned": found.response is not None,
        "verdict": found.verdict.level,
        "reason": found.verdict.reasons[0] if found.verdict.reasons else "",
        "seconds": process_time() - begin,
    }


def main(arguments: list[str] | None = None) -> list[dict[str, Any]]:
    """Print and write the table; return its rows."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("figures"))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--unknown-noise", action="store_true", help="a belief without noise_sigma")
    parser.add_argument("--contact", default="auto", help="contact model (default auto)")
    parser.add_argument("--logs", nargs="+", choices=[*LOGS, *BELIEFS], default=[*LOGS, *BELIEFS])
    options = parser.parse_args(arguments)
    scene = ms.Scene.load("sphere_noisy")
    sound, rows = press(scene, options.seed), []
    for name in options.logs:
        belief = scene.belief(contact=options.contact, **BELIEFS.get(name, {}))
        if options.unknown_noise:
            belief = replace(belief, noise_sigma=None)
        rows.append(row(scene, name, LOGS[name](sound) if name in LOGS else sound, belief))
        print(line(rows[-1]), flush=True)
    names = ("log", "error_mm", "sigma_mm", "learned", "verdict", "reason", "seconds")
    path = options.out / "wrong_logs.csv"
    with atomic(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, names)
        table.writeheader()
        table.writerows(rows)
    kinds = {"error (rms)": "error_mm", "stated sigma (median)": "sigma_mm"}
    shown = {
        f"{r['log']}: {r['verdict']}": {kind: r.get(key) for kind, key in kinds.items()}
        for r in rows
    }
    theme.save(dots(shown, "mm"), options.out, "wrong_logs")
    return rows


def line(row: dict[str, Any]) -> str:
    """One row of the table."""
    head = f"{row['log']:38}"
    if "error_mm" not in row:
        return f"{head}{row['verdict']}: {row['reason']}"
    return (
        f"{head}{row['error_mm']:8.3f} mm at {row['sigma_mm']:8.3f}"
        f"{', learned' if row['learned'] else '':10}{row['seconds']:5.1f} s  {row['verdict']}"
        f"{': ' if row['reason'] else ''}{row['reason'][:150]}"
    )


if __name__ == "__main__":
    main()
