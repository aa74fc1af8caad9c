"""Pictures of the effects: readings of one taxel along a crossing, with an effect off and on."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from meshskin import Body, Scene, Skin, effects
from meshskin.geometry.region import Cap
from meshskin.report import theme
from meshskin.scene.settings import Readout
from meshskin.simulation.readout import contact_frames
from meshskin.simulation.simulate import prepare, run

RADII = (0.112, 0.1, 0.09)
"""Semi-axes of the body, m: as unequal as circular patches allow, so that all effects act."""
ARGUMENTS: dict[str, dict[str, object]] = {
    "layer": {"thickness": 0.006},
    "disc_averaging": {"radius": 0.003},
    "joint_friction": {"torque": 0.02},
}
"""Arguments of the effects whose parameters have no defaults."""
CAPTION = (
    "The pictures are made by the build. The scene is `ellipsoid` without noise, with semi-axes of "
    '112, 100 and 90 mm and circular patches (`contact = "hertz"`), simulated once. Each effect '
    "changes the same contacts, with its defaults, or `layer` of 6 mm, `disc_averaging` of 3 mm "
    "(the taxels have 2) and `joint_friction` of 0.02 N m. Drawn are the readings of one taxel, "
    "over the distance of the *recorded* contact point from it, in the crossing in which the "
    "effect changes them most among those through the middle of a taxel; on the right is what "
    "changes: the readings, the recorded contact point, or the recorded force."
)
SPAN = 9e-3
"""Distance on both sides of a taxel that is drawn, m: twice the radius of the contact patch."""
CENTRAL = 0.9
"""Least peak of a crossing's readings, relative to the highest, to count as through the middle."""


def draw(folder: Path) -> dict[str, Path]:
    """The picture of each registered effect, by name; those that `folder` holds are kept."""
    paths = {name: folder / f"{name}.png" for name in effects.NAMES}
    if all(path.is_file() for path in paths.values()):
        return paths
    folder.mkdir(parents=True, exist_ok=True)
    body = Body.ellipsoid(RADII)
    skin = Skin.cover(body, spacing=5e-3, count=40, region=Cap((0.0, -1.0, 0.0)))
    scene = Scene.load("ellipsoid").with_(
        body=body, skin=skin, effects=(), contact="hertz", readout=Readout()
    )
    simulator, path = prepare(scene)
    frames = contact_frames(scene, simulator.loop, list(run(scene, simulator, path)))
    off = effects.EffectPipeline.from_effects((), scene.context(0), scene.reading_model)
    plain = off.read(frames, scene.skin.poses)
    for name, file in paths.items():
        effect = effects.find(name)(**ARGUMENTS.get(name, {}))
        on = effects.EffectPipeline.from_effects((effect,), scene.context(0), scene.reading_model)
        readings, recorded = on.read(frames, scene.skin.poses), on.record(frames)
        _draw(file, scene, frames, plain, recorded, readings)
    return paths


def width(picture: Path) -> int:
    """Width of a picture on a page, pixels, at which its text is as large as the page's."""
    from PIL import Image

    with Image.open(picture) as image:
        return round(image.width * 110 / theme.DPI)


@theme.styled
def _draw(file, scene, frames, plain, recorded, readings) -> None:  # type: ignore[no-untyped-def]
    taxel, rows = _crossing(scene, frames, plain, recorded, readings)
    figure = theme.new_figure(7.2, 2.6)
    axes = theme.add_axes(figure, 0.6, 0.45, 3.4, 1.9)
    change = theme.add_axes(figure, 4.8, 0.45, 2.2, 1.9)
    at, along = scene.skin.positions[taxel], frames.points[rows[-1]] - frames.points[rows[0]]
    along /= np.linalg.norm(along)
    x = 1e3 * (frames.points[rows] - at) @ along
    moved = 1e3 * (recorded.points[rows] - at) @ along
    style: dict[str, Any] = {"marker": ".", "lw": 1.1, "ms": 3.5}
    axes.plot(x, plain[rows, taxel] / 1e3, color=theme.TRUTH, label="off", **style)
    axes.plot(moved, readings[rows, taxel] / 1e3, color=theme.WARNING, label="on", **style)
    axes.set(xlabel="contact point to taxel, mm", title="reading of one taxel, kPa")
    axes.legend(loc="upper right")
    shift = np.linalg.norm(recorded.points - frames.points, axis=1)[rows]
    title, values = "on minus off, kPa", (readings - plain)[rows, taxel] / 1e3
    if not values.any():
        title, values = "shift of the recorded point, mm", 1e3 * shift
    if not values.any():
        title, values = "recorded force, on minus off, N", (recorded.force - frames.force)[rows]
    change.plot(x, values, color=theme.WARNING, **style)
    change.axhline(0.0, color=theme.FAINT, lw=0.8, zorder=0)
    change.set(xlabel="contact point to taxel, mm", title=title)
    theme.save(figure, file.parent, file.stem)


def _crossing(scene, frames, plain, recorded, readings):  # type: ignore[no-untyped-def]
    """The taxel and the frames of the crossing that the effect changes most."""
    shift = np.linalg.norm(recorded.points - frames.points, axis=1)
    scale = {"readings": plain.max(), "points": SPAN, "force": frames.force.max()}
    change = (
        np.abs(readings - plain) / scale["readings"]
        + (shift / scale["points"])[:, None]
        + (np.abs(recorded.force - frames.force) / scale["force"])[:, None]
    )
    best = None
    for taxel, at in enumerate(scene.skin.positions):
        near = np.linalg.norm(frames.points - at, axis=1) < SPAN
        edges = np.flatnonzero(np.diff(near.astype(int)))
        for first, last in pairwise(edges):
            rows = np.arange(first + 1, last + 1)
            central = plain[rows, taxel].max() >= CENTRAL * plain.max()
            if not (central and near[rows].all() and _is_straight(frames.points[rows])):
                continue
            score = change[rows, taxel].mean()
            if best is None or score > best[0]:
                best = score, taxel, rows
    assert best is not None, "no lane crosses the middle of a taxel"
    return best[1:]


def _is_straight(points) -> bool:  # type: ignore[no-untyped-def]
    """Whether a crossing runs one way, from one side of the taxel to the other."""
    along = (points - points[0]) @ (points[-1] - points[0])
    far = np.linalg.norm(points[-1] - points[0]) > SPAN
    return bool(far and np.all(np.diff(along) > 0))
