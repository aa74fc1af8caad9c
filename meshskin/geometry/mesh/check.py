"""Checks of a mesh: what is repaired, what is refused, where, and the remedy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ...core.arrays import Array, Index
from ...core.errors import MeshError
from . import mesh_file, non_manifold, repair, self_intersection
from .topology import NEXT, PREVIOUS, connected_components, edge_keys, face_components, neighbours

NONE: Index = np.zeros(0, dtype=np.intp)
"""no faces"""

SHOWN = 5
"""most faces listed in a message, to keep it within two lines"""
SLIVER = 1e-9
"""twice a face's area over the square of its longest side, up to which it is reported as without
area: of a face of 10 mm, a height of 10 pm"""

MAX_EXTENT, MIN_EXTENT = 5.0, 5e-3
"""largest and least extent of a body, m: others are most likely in another unit"""


@dataclass(frozen=True)
class Finding:
    """One thing found in a mesh."""

    what: str
    """description, with the count"""
    points: Array
    """(k, 3) m, where"""
    faces: Index
    """(k,) numbers in the file of the faces concerned; empty where vertices are"""
    verdict: str
    """one of "repaired", "refused" and "noted" """
    remedy: str = ""
    """how to repair the file, where the mesh is refused"""
    crossing: bool = False
    """whether parts of the mesh touch or intersect there"""

    def error(self) -> MeshError:
        """The MeshError of a refused finding."""
        place = self.where()
        return MeshError(f"{self.what} ({place})" if place else self.what, remedy=self.remedy)

    def where(self) -> str:
        """The first point and the first faces, as text."""
        words = []
        if len(self.points):
            near = ", ".join(f"{1e3 * x:.1f}" for x in self.points[0])
            words.append(f"the first near ({near}) mm")
        if len(self.faces):
            ids = ", ".join(str(i) for i in self.faces[:SHOWN])
            more = ", ..." if len(self.faces) > SHOWN else ""
            words.append(f"faces {ids}{more}")
        return "; ".join(words)


@dataclass(frozen=True)
class MeshCheck:
    """A repaired mesh, and the findings of its check."""

    vertices: Array
    """(n, 3) m"""
    faces: Index
    """(m, 3)"""
    findings: tuple[Finding, ...]
    """in the order of the checks; the first refused one may prevent further checks"""
    row: Index
    """(k,) rows of `faces` for the k faces of the file, or for their duplicates; -1: dropped"""
    crossed: Index
    """rows (l,) of `faces` that intersect others, or have edges of more than two faces, and one of
    each solid part within another one"""

    @property
    def repairs(self) -> tuple[str, ...]:
        """Descriptions of the repairs."""
        return tuple(f.what for f in self.findings if f.verdict == "repaired")

    def patches(self, names: Mapping[str, Index]) -> dict[str, Index]:
        """Rows of `faces` by name, from the numbers (k,) in the file by name."""
        rows = {name: np.unique(self.row[numbers]) for name, numbers in names.items()}
        return {name: here[here >= 0] for name, here in rows.items()}

    @property
    def refused(self) -> tuple[Finding, ...]:
        """The findings for which the mesh is refused as a body."""
        return tuple(f for f in self.findings if f.verdict == "refused")


def check_mesh(vertices: Array, faces: Index, open: bool = False) -> MeshCheck:
    """Check a mesh (vertices (n, 3) m, faces (m, 3)), and make the repairs that are safe.

    With `open`, borders, edges of more than two faces, inconsistent winding and self-intersections
    are noted, not refused.
    """
    edit = repair.MeshEdit(vertices, faces, np.arange(len(faces)))
    if unusable := _unusable(edit):
        return _refused(vertices, faces, unusable)
    repair.drop_unreferenced(edit)
    if not np.max(np.ptp(edit.vertices, axis=0)) > 0.0:
        return _refused(
            vertices,
            faces,
            _finding(edit, "the mesh is a point", np.arange(len(faces)), "check its export"),
        )
    repair.merge_vertices(edit)
    repair.drop_degenerate_faces(edit)
    repair.drop_duplicate_faces(edit)
    if not len(edit.faces):
        no_area = Finding("no face has an area", vertices[:1], NONE, "refused", "check its export")
        return _refused(vertices, faces, no_area)
    across = repair.make_winding_consistent(edit)
    component = face_components(across)
    turned, nested = repair.orient_outward(edit, across, component, open)
    nested = edit.number[nested]
    if turned:
        across, _ = neighbours(edit.faces)
    split = non_manifold.split_edges(edit) if np.any(across < 0) else NONE
    if len(split):
        across, _ = neighbours(edit.faces)
        component = face_components(across)
    findings = [Finding(what, points, NONE, "repaired") for what, points in edit.repairs]
    findings += _edges(edit, across, open)
    findings += _slivers(edit)
    if component.max() > 0:
        first = np.unique(component, return_index=True)[1]
        what = f"{component.max() + 1} separate parts"
        findings.append(_finding(edit, what, first, refused=False))
    findings += _self_intersections(edit, across, open)
    row = np.full(len(faces), -1)
    row[edit.number] = np.arange(len(edit.faces))
    row[edit.twins[:, 0]] = row[edit.twins[:, 1]]
    numbers = np.concatenate([split, nested, *(f.faces for f in findings if f.crossing)])
    crossed = np.unique(row[numbers])
    faces = np.ascontiguousarray(edit.faces)
    return MeshCheck(edit.vertices, faces, tuple(findings), row, crossed)


def _refused(vertices: Array, faces: Index, finding: Finding) -> MeshCheck:
    """The check of a mesh that is left as it is."""
    return MeshCheck(vertices, faces, (finding,), np.arange(len(faces)), NONE)


def _finding(
    edit: repair.MeshEdit, what: str, rows: Index, remedy: str = "", refused: bool = True
) -> Finding:
    verdict = "refused" if refused else "noted"
    return Finding(what, edit.centroids(rows), edit.number[rows], verdict, remedy)


def _unusable(edit: repair.MeshEdit) -> Finding | None:
    """What makes all other checks meaningless."""
    nowhere, faces = np.zeros((0, 3)), edit.faces
    if not len(faces):
        return Finding(
            "the mesh has no faces", nowhere, NONE, "refused", "check the file in a mesh viewer"
        )
    rows = np.flatnonzero(((faces < 0) | (faces >= len(edit.vertices))).any(axis=1))
    if len(rows):
        what = f"{len(rows)} faces refer to vertices that do not exist"
        return Finding(what, nowhere, rows, "refused", "export the mesh again")
    bad = np.asarray(~np.isfinite(edit.vertices).all(axis=1))
    rows = np.flatnonzero(bad[faces].any(axis=1))
    if not len(rows):
        return None
    corners = edit.vertices[faces[rows]].reshape(-1, 3)
    finite = corners[np.isfinite(corners).all(axis=1)]
    what = f"{len(np.unique(faces[rows][bad[faces[rows]]]))} vertices are not finite"
    remedy = "delete them and fill the holes in a mesh editor"
    return Finding(what, finite, rows, "refused", remedy)


def _edges(edit: repair.MeshEdit, across: Index, open: bool) -> list[Finding]:
    """Borders, edges of more than two faces, and edges whose two faces are wound inconsistently."""
    face, k = np.nonzero(across < 0)
    if not len(face):
        return []
    tail, head = edit.faces[face, NEXT[k]], edit.faces[face, PREVIOUS[k]]
    edge = edge_keys(tail, head, len(edit.vertices))
    _, place, count = np.unique(edge, return_inverse=True, return_counts=True)
    share = count[place]
    found = []
    border = share == 1
    if border.any():
        loops, largest = _loops(tail[border], head[border], edit.vertices)
        found.append(
            _finding(
                edit,
                f"the mesh is not watertight: {int(border.sum())} border edges, "
                f"{loops} hole{'s' if loops > 1 else ''}, the longest {largest * 1e3:.3g} mm long",
                face[border],
                "fill the holes in a mesh editor, or open=True if it is meant to be open",
                not open,
            )
        )
    for rows, words, remedy in (
        (
            share > 2,
            "edges of more than two faces",
            "delete inner faces, or separate parts that touch, in a mesh editor, or open=True",
        ),
        (
            share == 2,
            "edges whose faces are wound inconsistently",
            "cut the one-sided band (Moebius strip) in a mesh editor",
        ),
    ):
        if rows.any():
            edges = len(np.unique(place[rows]))
            finding = _finding(edit, f"{edges} {words}", face[rows], remedy, not open)
            found.append(replace(finding, crossing=bool(share[rows][0] > 2)))
    return found


def _loops(tail: Index, head: Index, vertices: Array) -> tuple[int, float]:
    """Number of loops of border edges, and the length of the longest in m."""
    label = connected_components(tail, head, len(vertices))[tail]
    length = np.bincount(label, np.linalg.norm(vertices[head] - vertices[tail], axis=1))
    return len(np.unique(label)), float(length.max())


def _slivers(edit: repair.MeshEdit) -> list[Finding]:
    """Faces of three vertices on a line; they are kept, because they close the mesh."""
    a, b, c = (edit.vertices[edit.faces[:, k]] for k in range(3))
    area2 = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    longest = np.max([np.sum((p - q) ** 2, axis=1) for p, q in ((a, b), (b, c), (c, a))], axis=0)
    thin = np.flatnonzero(area2 <= SLIVER * longest)
    if not len(thin):
        return []
    what = f"{len(thin)} faces without area kept: they close the mesh"
    return [_finding(edit, what, thin, refused=False)]


def _self_intersections(edit: repair.MeshEdit, across: Index, open: bool) -> list[Finding]:
    closed = bool(np.all(across >= 0))
    one, two, where = self_intersection.edge_face_intersections(edit.vertices, edit.faces, closed)
    if not len(one):
        return []
    return [
        Finding(
            f"the mesh intersects itself at {len(one)} points",
            where,
            edit.number[np.stack([one, two], axis=1).ravel()],
            "noted" if open else "refused",
            "unite the parts in a mesh editor (boolean union), or open=True",
            crossing=True,
        )
    ]


def check_extent(vertices: Array) -> None:
    """Raise MeshError, with the likely unit, for vertices (n, 3), m, of an improbable extent."""
    extent = float(np.max(np.ptp(vertices, axis=0)))
    if MIN_EXTENT <= extent <= MAX_EXTENT:
        return
    names = {"mm": "millimetres", "cm": "centimetres", "in": "inches"}
    likely = [u for u in names if MIN_EXTENT <= extent * mesh_file.UNITS[u] <= MAX_EXTENT]
    if extent > MAX_EXTENT and likely:
        unit = likely[0]
        remedy = f"likely {names[unit]}: units='{unit}', or radius_{unit} etc. in a scene file"
    elif extent < MIN_EXTENT and extent >= mesh_file.UNITS["mm"] * MIN_EXTENT:
        remedy = "likely scaled to m already, or given in m twice: units='m'"
    else:
        remedy = "give lengths in m, or the file's units"
    limit = f"{MIN_EXTENT * 1e3:g} mm to {MAX_EXTENT:g} m"
    raise MeshError("largest extent", value=f"{extent:.4g} m", limit=limit, remedy=remedy)
