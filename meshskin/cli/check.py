"""`meshskin check MESH`: find defects of a mesh.

Find defects of a mesh. Exit code 0: it can be a body; 1: it cannot; 2: the file cannot be read.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..core.errors import MeshError, OutputError
from ..core.progress import Stage
from . import body_options
from .options import option, real, refuse
from .progress_bar import bar

if TYPE_CHECKING:
    from ..geometry.mesh.check import Finding, MeshCheck

COLOURS = {"refused": "#c62828", "noted": "#ef6c00", "repaired": "#1565c0"}
SIZES = {"refused": 5.0, "noted": 4.0, "repaired": 1.5}
"""Marker sizes by verdict, points."""
PICTURES = (".png", ".pdf", ".svg")
FORCE = 3.0
"""Force of the contacts, N, as in the paper."""
DRAWN = 20_000
"""Largest number of faces, and of points of one finding, that a drawing shows."""


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    positive = real(above=0.0)
    option(parser, "mesh MESH", body_options.HELP, Path)
    body_options.add(parser)
    option(
        parser, "--indenter-radius-mm MM[,MM...]", "say what indenters of these radii reach of the "
        "visible surface, and recommend one of several", radii,
    )  # fmt: skip
    option(parser, "--force-n FORCE_N", f"force of these contacts (default {FORCE:g})", positive)
    option(parser, "--young-kpa YOUNG_KPA", "Young's modulus of the skin (default 200)", positive)
    option(
        parser, "--skin-mm SKIN_MM", "press the surface of a skin of this thickness, which bridges "
        "small features (slower)", positive,
    )  # fmt: skip
    option(parser, "--out FILE", "draw the findings (.png, .pdf, .svg or .html)", Path)


def command(options: argparse.Namespace) -> int:
    """Print the findings; draw them if --out is given."""
    from ..geometry.mesh.check import check_extent, check_mesh

    kind = None if options.out is None else options.out.suffix.lower()
    if kind not in (None, ".html", *PICTURES):
        raise OutputError(
            "unknown suffix of a drawing", value=kind, limit=f".html, {', '.join(PICTURES)}"
        )
    if options.indenter_radius_mm is None:
        names, what = ("force_n", "young_kpa", "skin_mm"), "{} is for contacts of an indenter"
        refuse(options, names, what, "give --indenter-radius-mm, too")
    given = options.units
    with bar(quiet=False) as progress:
        stage = Stage(progress, "check", 2)
        why = body_options.settle_units(options.mesh, options)
        raw = body_options.triangles(options.mesh, options)
        stage.step()
        found = check_mesh(raw.vertices, raw.faces, bool(options.open))
        stage.step()
    finite = found.vertices[np.isfinite(found.vertices).all(axis=1)]
    size = 1e3 * np.ptp(finite, axis=0) if len(finite) else np.zeros(3)
    print(f"{options.mesh.name}: {len(found.vertices)} vertices, {len(found.faces)} faces, "
          f"{size[0]:.4g} x {size[1]:.4g} x {size[2]:.4g} mm")  # fmt: skip
    if options.units != given:
        print(f"  {'units':9} {options.units}, {why}; give --units if it is another one")
    for finding in found.findings:
        print(f"  {finding.verdict:9} {finding.what}")
        if (place := finding.where()) and not everywhere(finding, found):
            print(f"  {'':9}   {place}")
        if finding.remedy and finding.verdict == "refused":
            remedy = finding.remedy.replace("open=True", "--open (open=True in Python)")
            print(f"  {'':9}   remedy: {remedy}")
    patches(found, raw.names)
    usable = not found.refused
    try:
        check_extent(finite if len(finite) else np.zeros((1, 3)))
    except MeshError as error:
        usable = False
        print(f"  {'refused':9} {error}")
    if options.indenter_radius_mm:
        if usable:
            indenters(options)
        else:
            print(f"  {'indenter':9} not tried on a mesh that cannot be a body: see the remedies")
    print("can be a body" if usable else "cannot be a body")
    if kind == ".html":
        page(found, options.mesh.name, options.out)
    elif kind:
        picture(found, options.mesh.name, options.out)
    return 0 if usable else 1


def radii(text: str) -> tuple[float, ...]:
    """Radii in m of a list in mm, separated by commas."""
    return tuple(1e-3 * real(above=0.0)(part) for part in text.split(","))


def indenters(options: argparse.Namespace) -> None:
    """Print what each indenter reaches of the visible surface, and which of several is best."""
    from ..contact.material import Material
    from ..exploration.reach import reach, recommendation

    young = options.young_kpa
    with bar(quiet=False) as progress:
        found = reach(
            body_options.load(options.mesh, options),
            options.indenter_radius_mm,
            force=FORCE if options.force_n is None else options.force_n,
            material=None if young is None else Material(young=1e3 * young),
            skin=None if options.skin_mm is None else 1e-3 * options.skin_mm,
            progress=progress,
        )
    for one in found:
        print(f"  {'indenter':9} {one}")
    if len(found) > 1:
        print(f"  {'indenter':9} recommended: {recommendation(found)} (of the visible surface)")


def patches(found: MeshCheck, names: Mapping[str, Any]) -> None:
    """Print the named patches of the mesh, which a skin may cover."""
    corners = 1e2 * found.vertices[found.faces] if names else np.zeros((0, 3, 3))
    for name, rows in sorted(found.patches(names).items()):
        a, b, c = np.swapaxes(corners[rows], 0, 1)
        area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
        print(f"  {'patch':9} {name}: {len(rows)} faces, {area:.4g} cm2")


def everywhere(finding: Finding, found: MeshCheck) -> bool:
    """Whether a finding is a repair of more than half the vertices, as merging those of an STL."""
    return finding.verdict == "repaired" and len(finding.points) > 0.5 * len(found.vertices)


def thinned(rows: Any) -> Any:
    """At most DRAWN of the rows, evenly spaced."""
    return rows[:: max(1, -(-len(rows) // DRAWN))]


def marks(found: MeshCheck) -> Iterator[tuple[Any, float, str, str]]:
    """Points (k, 3), mm, marker size, colour and legend text of each finding, the largest last;
    repairs all over the mesh have no points."""
    for finding in sorted(found.findings, key=lambda one: SIZES[one.verdict]):
        points, text = 1e3 * finding.points, f"{finding.verdict}: {finding.what}"
        if everywhere(finding, found):
            points, text = points[:0], f"{text} (everywhere, not drawn)"
        yield thinned(points), SIZES[finding.verdict], COLOURS[finding.verdict], text


def drawable(found: MeshCheck) -> Any:
    """At most DRAWN faces (k, 3) whose vertices exist and are finite."""
    finite = np.asarray(np.isfinite(found.vertices).all(axis=1))
    named = (found.faces >= 0) & (found.faces < len(finite))
    faces = found.faces[named.all(axis=1)]
    return thinned(faces[finite[faces].all(axis=1)])


def picture(found: MeshCheck, title: str, path: Path) -> None:
    """Draw the mesh and the points of the findings with matplotlib."""
    from matplotlib.figure import Figure

    from ..core.atomic_io import atomic

    figure = Figure(figsize=(9, 7), layout="constrained")
    axes: Any = figure.add_subplot(projection="3d")
    mm, faces = 1e3 * found.vertices, drawable(found)
    if len(faces):
        axes.plot_trisurf(*mm.T, triangles=faces, color="#b0bec5", alpha=0.35, linewidth=0)
    axes.computed_zorder = False  # draw findings over the mesh, also those inside it
    for at, size, color, text in marks(found):
        axes.scatter(*at.T, s=size**2, color=color, depthshade=False, zorder=10, label=text)
    axes.set(xlabel="x (mm)", ylabel="y (mm)", zlabel="z (mm)", title=title)
    axes.set_aspect("equal")
    if axes.get_legend_handles_labels()[0]:
        axes.legend(loc="upper left", fontsize=8)
    with atomic(path) as temporary:
        figure.savefig(temporary, format=path.suffix.lower()[1:], dpi=150)


def page(found: MeshCheck, title: str, path: Path) -> None:
    """Draw the mesh and the points of the findings as an interactive page with plotly."""
    import plotly.graph_objects as go

    from ..core.atomic_io import atomic

    faces, mm = drawable(found), 1e3 * found.vertices
    grey = {"color": "#b0bec5", "opacity": 0.5, "name": "mesh", "hoverinfo": "skip"}
    x, y, z = mm.T
    i, j, k = faces.T
    traces: list[Any] = [go.Mesh3d(x=x, y=y, z=z, i=i, j=j, k=k, **grey)]
    for at, size, color, text in marks(found):
        x, y, z = at.T
        marker = {"size": size, "color": color}
        traces.append(go.Scatter3d(x=x, y=y, z=z, mode="markers", marker=marker, name=text))
    figure = go.Figure(traces)
    axes = {f"{a}axis_title": f"{a} (mm)" for a in "xyz"}
    figure.update_layout(title=title, scene={"aspectmode": "data", **axes}, showlegend=True)
    with atomic(path) as temporary:
        temporary.write_text(figure.to_html(include_plotlyjs=True), encoding="utf-8")
