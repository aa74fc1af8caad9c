"""`meshskin init FILE`: write a commented scene for a mesh, or a map for a robot's log.

For a mesh, or a link of a URDF file, FILE gives a scene. The unit, the borders, the size and the
place of the skin, the indenter, the force and the lanes are chosen; the file and the terminal give
the reason for each. For a log, the map of its streams is written, with what else each could be.
Both are starting points, to be edited.
"""

from __future__ import annotations

import argparse
import json
import math
import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..core.errors import ConfigError, MeshError, SkinError
from . import body_options
from .options import option, refuse
from .progress_bar import bar

if TYPE_CHECKING:
    from ..exploration.reach import Reach
    from ..geometry.body import Body

SPACING = 5e-3
"""Distance of the taxels that are proposed, m: that of the paper's skin."""
TAXELS = 80
"""Most taxels that are proposed, as many as the paper has: a first run then takes seconds."""
SIDES = ((0, 0, 1), (1, 0, 0), (0, 1, 0), (-1, 0, 0), (0, -1, 0), (0, 0, -1))
"""Directions whose outermost point could be the middle of the skin; the first is the default."""
LANES = 0.55
"""Distance of the lanes over the reach of a contact (its radius and a taxel's): as on the paper's
sphere, 3.5 mm over 6.3 mm. Wider lanes leave taxels that one lane touches only."""
RADII = (10e-3, 5e-3, 2.5e-3)
"""Radii, m, of the indenters that are compared: the paper's, and finer ones."""


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    option(parser, "file FILE", "mesh, URDF file or log", Path)
    option(
        parser, "--out FILE", "file to write (default: NAME.toml, named after the mesh or log, in "
        "this folder); an existing one is not replaced", Path,
    )  # fmt: skip
    body_options.add(parser)


def command(options: argparse.Namespace) -> int:
    """Write the scene or the map."""
    from ..core.atomic_io import write_text

    file = options.file
    if not file.exists():
        raise ConfigError("no such file", value=str(file))
    stem = options.link or (file.stem if file.is_file() else file.resolve().name)
    is_body = file.is_file() and (body_options.is_mesh(file) or file.suffix.lower() == ".urdf")
    out = options.out or Path(f"{stem}.toml" if is_body else f"{stem}_map.toml")
    if out.suffix != ".toml":
        raise ConfigError(
            "the file to write has no .toml suffix",
            value=f"--out {out}",
            remedy=f"give --out {out.with_name(out.name + '.toml')}",
        )
    if out.exists():
        raise ConfigError(f"{out} exists already", remedy="give another --out, or remove it")
    if not is_body:
        refuse(options, body_options.NAMES, f"{{}} is for a mesh, got {file.name}")
    text, run = scene(options, out) if is_body else log_map(file, out)
    write_text(out, text)
    for line in text.splitlines():
        if "  # " in line and not line.startswith("#"):
            print(f"  {line}")
    print(f"{out}: {'scene' if is_body else 'map'} written; edit it, then\n  {run}")
    return 0


def scene(options: argparse.Namespace, out: Path) -> tuple[str, str]:
    """The text of a scene for the mesh or link of the options, and the command that runs it."""
    from ..exploration.reach import NEARLY, reach, recommended
    from ..skin.files.table import DISC_RADIUS

    why = body_options.settle_units(options.file, options)
    body, opened = _body(options)
    whole = int(body.mesh.area / (math.sqrt(0.75) * SPACING**2))
    with bar(quiet=False) as progress:
        found = reach(body, RADII, progress=progress)
    best = recommended(found)
    count = _count(body, whole)
    direction = _direction(body, count, best)
    where = os.path.relpath(options.file.resolve(), out.resolve().parent)
    lines = [
        f"# A scene for {options.file.name}, proposed by `meshskin init`. Keys name their unit.",
        "# `meshskin scenes --show sphere` shows a whole scene, `meshskin effects` what to add.",
        "",
        "[body]",
        f"mesh = {json.dumps(Path(where).as_posix())}",
        *([f"units = {json.dumps(options.units)}  # {why}"] if why else []),
        *([f"open = true  # {opened}"] if options.open else []),
        *_urdf(options),
        "",
        "[skin]",
        f"spacing_mm = {1e3 * SPACING:g}  # that of the paper's skin",
        f"count = {count}  # about the {'direction' if direction else 'top'}; without it: all of "
        f"the body or region, about {whole}",
        f"disc_radius_mm = {1e3 * DISC_RADIUS:g}",
        *direction,
        *_patches(body),
        "",
        "[material]",
        "young_kpa = 200  # of the soft layer; 200 is that of soft silicone rubber",
        "poisson = 0.49",
        "# thickness_mm = 3  # of the soft layer, where it is thin",
        "",
        "[indenter]",
        *(f"# {one}" for one in found),
        f"radius_mm = {1e3 * best.radius:g}  # reaches {best.share:.0%} of what is visible: "
        f"the largest of these that reaches {NEARLY:.0%} of what the best one does",
        "",
        "[law]",
        f"force_reference_n = {_force(best):g}  # {_why(best)}",
        "",
        "[exploration]",
        f"lane_spacing_mm = {_lanes(best):.1f}  # half the reach of a contact on a taxel",
        "",
        "[loop]",
        'mode = "quasi_static"  # the body moves exactly; "arm": by the arm of [arm] urdf, tip',
        "",
        "[readout]",
        "threshold_relative = 0.05  # readings up to 5 times the noise below are not recorded",
        "",
        "[[effects]]",
        'kind = "gaussian_noise"',
        "sigma_relative = 0.01  # of the peak pressure",
    ]
    return "\n".join(lines) + "\n", f"meshskin run {out} --out out/"


def _body(options: argparse.Namespace) -> tuple[Body, str]:
    """The body, opened where it is refused only, and why it is. Raises MeshError."""
    if options.open:
        return body_options.load(options.file, options), "as asked"
    try:
        return body_options.load(options.file, options), ""
    except MeshError as error:
        options.open = True
        return body_options.load(
            options.file, options
        ), f"{error.what.partition(' (')[0]}: see meshskin check"


def _count(body: Body, whole: int) -> int:
    """The number of taxels: TAXELS, or fewer that fit a body for about `whole`."""
    from ..skin.skin import Skin

    count = min(whole, TAXELS)
    while count > 1:
        try:
            Skin.cover(body, SPACING, count)
        except SkinError:
            count = 3 * count // 4
        else:
            break
    return count


def _direction(body: Body, count: int, best: Reach) -> list[str]:
    """The key of a side whose taxels the indenter reaches better than those at the top, with how
    many of them; nothing where none is better."""
    from ..exploration.reach import NEARLY, contact_reasons
    from ..geometry.region import Whole
    from ..scene.scene import Scene
    from ..scene.settings import Loop
    from ..skin.skin import Skin

    reached = {}
    for side in SIDES:
        try:
            skin = Skin.cover(body, SPACING, count, Whole(side))
        except SkinError:
            continue
        scene = Scene(body=body, skin=skin, loop=Loop(mode="quasi_static"))
        reasons = contact_reasons(scene, best.radius, best.force)[1]
        reached[side] = float(np.mean(reasons == ""))
    top, side = reached.get(SIDES[0], 0.0), max(reached, key=lambda one: reached[one])
    if top >= NEARLY * reached[side]:
        return []
    why = f"of these taxels {reached[side]:.0%} are reached, of those at the top {top:.0%}"
    return [f"direction = {json.dumps(side)}  # {why}"]


def _force(best: Reach) -> float:
    """The contact force, N, rounded down to two digits."""
    scale = 10.0 ** (math.floor(math.log10(best.force)) - 1)
    return math.floor(best.force / scale + 1e-9) * scale


def _why(best: Reach) -> str:
    """The reason for the contact force."""
    from ..scene.settings import Law

    usual = Law().force_reference
    less = f"with {usual:g} N the patch is too wide for a contact model"
    return less if best.force < usual else "the default"


def _lanes(best: Reach) -> float:
    """The distance of the lanes, mm, at most the usual one, by Hertz's contact on a plane."""
    from ..contact.material import Material
    from ..scene.settings import Exploration
    from ..skin.files.table import DISC_RADIUS

    radius = (0.75 * best.force * best.radius / Material().effective_modulus) ** (1 / 3)
    return 1e3 * min(LANES * (radius + DISC_RADIUS), Exploration().lane_spacing)


def _urdf(options: argparse.Namespace) -> list[str]:
    """The keys of a link of a URDF file."""
    if options.link is None or body_options.is_mesh(options.file):
        return []
    folders = [str(folder.resolve()) for folder in options.folder or ()]
    keys = {"link": options.link, "folders": folders, "link_mesh": options.link_mesh}
    return [f"{key} = {json.dumps(value)}" for key, value in keys.items() if value]


def _patches(body: Body) -> list[str]:
    """Comments on the region that the skin covers."""
    lines = [
        "# The taxels are those nearest to the centre of a region, by default the top; others:"
    ]
    names = sorted(body.patches)
    lines += [f"# region = {{patch = {json.dumps(name)}}}" for name in names[:SHOWN]]
    if len(names) > SHOWN:
        lines.append(f"# and {len(names) - SHOWN} more patches: meshskin check")
    return [*lines, "# region = {direction = [1, 0, 0], angle_deg = 40}"]


SHOWN = 8
"""Patches that a scene lists."""


NO_PLACES = """\
# Nothing says where the skin was touched. Name the columns of contact points (frame of the body)
# and of forces, or a stream of poses or of joint angles:
# [[stream]]
# topic = "contacts"
# kind = "contacts"
# values = ["x", "y", "z", "force"]
# unit = "mm"
"""
"""Comment in the map of a log without contacts, poses and joint angles."""


def log_map(file: Path, out: Path) -> tuple[str, str]:
    """The text of a map of a log, and the command that reads the log by it; the streams are
    printed. Raises ConfigError."""
    from ..recording import csv_log
    from ..recording.log_map import LogMap
    from ..recording.readers import read_and_suggest
    from ..recording.stream import CONTACTS, JOINTS, POSE
    from .log import first_map, listing

    if csv_log.find(file):
        raise ConfigError(
            f"{file} needs no map: it holds contacts.csv and readings.csv",
            remedy=f"meshskin calibrate {file} --body MESH --indenter-radius-mm MM --out out/",
        )
    log, could = read_and_suggest(file, progress=True)
    first = first_map(log, could, [])
    print(*listing(log, could), sep="\n")
    lines = [
        f"# The map of {file.name}, proposed by `meshskin init`: what each of its streams is.",
        "# Remove what is not used, and correct kind, unit and values.",
        "",
    ]
    for stream in first.streams:
        found = log[stream.topic]
        others = [one.kind for one in could[stream.topic] if one.kind != stream.kind]
        lines.append(
            f"# {len(found)} samples at {found.rate:.4g} Hz, of type {found.type or 'unknown'}"
        )
        if others:
            lines.append(f"# could also be: {', '.join(dict.fromkeys(others))}")
        _, _, table = LogMap((stream,)).to_toml().partition("\n\n")
        lines.append(table)
    named = {stream.topic for stream in first.streams}
    if other := [name for name in sorted(could) if could[name] and name not in named]:
        lines.append("# Other parts of the skin: each needs a map of its own.")
        lines += [*(f"# {name}" for name in other), ""]
    if unknown := [name for name in sorted(could) if not could[name]]:
        lines += [f"# Not recognized: {', '.join(unknown)}.", ""]
    if not any(first.of(kind) for kind in (CONTACTS, POSE, JOINTS)):
        lines.append(NO_PLACES)
    return "\n".join(lines), f"meshskin log {file} --map {out}"
