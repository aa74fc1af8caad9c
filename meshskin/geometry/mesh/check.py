"""What is wrong with a mesh, where, what was mended, and what would mend the rest."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...core.errors import MeshError
from . import non_manifold, repair, self_intersection
from .topology import NEXT, PREVIOUS, connected_components, edge_keys, face_components, neighbours

Array = NDArray[np.float64]
Index = NDArray[np.intp]

SHOWN = 5
"""faces named in a message"""


@dataclass(frozen=True)
class Finding:
    """One thing found in a mesh."""

    what: str
    """in words, with the count"""
    points: Array
    """(k, 3) m, where"""
    faces: Index
    """(k,) faces at fault, by their numbers in the file; empty where vertices are"""
    verdict: str
    """one of "repaired", "refused" and "noted" """
    remedy: str = ""
    """what would mend it, where it is refused"""
    crossing: bool = False
    """whether sheets of the mesh meet or cross there"""

    def error(self) -> MeshError:
        """The error that a refused finding is raised as."""
        place = self.where()
        return MeshError(f"{self.what} ({place})" if place else self.what, remedy=self.remedy)

    def where(self) -> str:
        """The first place and faces, in words."""
        words = []
        if len(self.points):
            near = np.array2string(self.points[0], precision=4, separator=", ")
            words.append(f"the first near {near} m")
        if len(self.faces):
            ids = ", ".join(str(i) for i in self.faces[:SHOWN])
            more = ", ..." if len(self.faces) > SHOWN else ""
            words.append(f"faces {ids}{more}")
        return "; ".join(words)


@dataclass(frozen=True)
class Survey:
    """A mesh after its repairs, and everything found in it."""

    vertices: Array
    """(n, 3) m"""
    faces: Index
    """(m, 3)"""
    findings: tuple[Finding, ...]
    """in the order of finding; a refused one may hide others that depend on it"""
    row: Index
    """(k,) where the k faces of the file are among `faces`, or what stands for them; -1: dropped"""
    crossed: Index
    """rows (l,) of `faces` at which the mesh crosses itself, or has edges of several faces"""

    @property
    def repairs(self) -> tuple[str, ...]:
        """What was put right, in words."""
        return tuple(f.what for f in self.findings if f.verdict == "repaired")

    def patches(self, names: Mapping[str, Index]) -> dict[str, Index]:
        """The rows of `faces` that carry each name, from their numbers in the file."""
        rows = {name: np.unique(self.row[numbers]) for name, numbers in names.items()}
        return {name: here[here >= 0] for name, here in rows.items()}

    @property
    def refused(self) -> tuple[Finding, ...]:
        """What keeps the mesh from being a body."""
        return tuple(f for f in self.findings if f.verdict == "refused")


def survey(vertices: Array, faces: Index, open: bool = False) -> Survey:
    """Look at a mesh (vertices (n, 3) m, faces (m, 3)), and mend what is safe to mend.

    With `open`, borders, edges of several faces, faces wound against each other and overlaps are
    noted, not refused.
    """
    draft = repair.MeshEdit(vertices, faces, np.arange(len(faces)))
    findings = _unusable(draft)
    if findings:
        return _as_it_was(vertices, faces, tuple(findings))
    repair.drop_unreferenced(draft)
    if not np.max(np.ptp(draft.vertices, axis=0)) > 0.0:
        flat = _finding(draft, "the mesh is a point", np.arange(len(faces)), "check its export")
        return _as_it_was(vertices, faces, (flat,))
    repair.merge(draft)
    repair.drop_points(draft)
    repair.drop_doubles(draft)
    if not len(draft.faces):
        empty = Finding("no face has an area", vertices[:1], np.zeros(0, dtype=np.intp), "refused",
                        "check its export")  # fmt: skip
        return _as_it_was(vertices, faces, (empty,))
    across = repair.wind(draft)
    part = face_components(across)
    if not open and repair.turn_outward(draft, part):
        across, _ = neighbours(draft.faces)
    none = np.zeros(0, dtype=np.intp)
    parted = non_manifold.part(draft) if np.any(across < 0) else none
    if len(parted):
        across, _ = neighbours(draft.faces)
        part = face_components(across)
    findings = [Finding(words, points, none, "repaired") for words, points in draft.marks]
    findings += _edges(draft, across, open)
    findings += _slivers(draft)
    if part.max() > 0:
        first = np.unique(part, return_index=True)[1]
        words = f"{part.max() + 1} separate parts"
        findings.append(Finding(words, draft.middles(first), draft.number[first], "noted"))
    findings += _overlaps(draft, across, open)
    row = np.full(len(faces), -1)
    row[draft.number] = np.arange(len(draft.faces))
    row[draft.twins[:, 0]] = row[draft.twins[:, 1]]
    numbers = np.concatenate([parted, *(f.faces for f in findings if f.crossing)])
    crossed = np.unique(row[numbers])
    faces = np.ascontiguousarray(draft.faces)
    return Survey(draft.vertices, faces, tuple(findings), row, crossed)


def _as_it_was(vertices: Array, faces: Index, findings: tuple[Finding, ...]) -> Survey:
    none = np.zeros(0, dtype=np.intp)
    return Survey(vertices, faces, findings, np.arange(len(faces)), none)


def _finding(
    draft: repair.MeshEdit, what: str, rows: Index, remedy: str, refused: bool = True
) -> Finding:
    return Finding(
        what, draft.middles(rows), draft.number[rows], "refused" if refused else "noted", remedy
    )


def _unusable(draft: repair.MeshEdit) -> list[Finding]:
    """What makes every further look meaningless."""
    none, nowhere = np.zeros(0, dtype=np.intp), np.zeros((0, 3))
    if not len(draft.faces):
        return [Finding("the mesh has no faces", nowhere, none, "refused",
                        "check the file in a mesh viewer")]  # fmt: skip
    if draft.faces.min() < 0 or draft.faces.max() >= len(draft.vertices):
        rows = np.flatnonzero(
            ((draft.faces < 0) | (draft.faces >= len(draft.vertices))).any(axis=1)
        )
        return [Finding(f"{len(rows)} faces name vertices that are not there", nowhere, rows,
                        "refused", "export the mesh anew")]  # fmt: skip
    bad = np.asarray(~np.isfinite(draft.vertices).all(axis=1))
    rows = np.flatnonzero(bad[draft.faces].any(axis=1))
    if not len(rows):
        return []
    corners = draft.vertices[draft.faces[rows]].reshape(-1, 3)
    beside = corners[np.isfinite(corners).all(axis=1)]
    count = len(np.unique(draft.faces[rows][bad[draft.faces[rows]]]))
    return [Finding(f"{count} vertices are not finite", beside, rows, "refused",
                    "delete them and fill the holes in a mesh editor")]  # fmt: skip


def _edges(draft: repair.MeshEdit, across: Index, open: bool) -> list[Finding]:
    """Borders, edges of several faces, and edges whose two faces are wound against each other."""
    face, k = np.nonzero(across < 0)
    if not len(face):
        return []
    tail, head = draft.faces[face, NEXT[k]], draft.faces[face, PREVIOUS[k]]
    edge = edge_keys(tail, head, len(draft.vertices))
    _, place, count = np.unique(edge, return_inverse=True, return_counts=True)
    share = count[place]
    found = []
    border = share == 1
    if border.any():
        loops, largest = _loops(tail[border], head[border], draft.vertices)
        found.append(
            _finding(
                draft,
                f"the mesh is not watertight: {int(border.sum())} border edges, "
                f"{loops} hole{'s' if loops > 1 else ''}, the longest {largest * 1e3:.3g} mm round",
                face[border],
                "fill the holes in a mesh editor, or open=True if it is meant to be open",
                not open,
            )
        )
    for rows, words, remedy in (
        (
            share > 2,
            "edges of more than two faces",
            "delete inner faces, or part sheets that touch, in a mesh editor, or open=True",
        ),
        (share == 2, "edges whose faces are wound against each other", "split a one-sided band"),
    ):
        if rows.any():
            edges = len(np.unique(place[rows]))
            finding = _finding(draft, f"{edges} {words}", face[rows], remedy, not open)
            found.append(replace(finding, crossing=bool(share[rows][0] > 2)))
    return found


def _loops(tail: Index, head: Index, vertices: Array) -> tuple[int, float]:
    """Number of loops of border edges, and the longest's length in m."""
    label = connected_components(tail, head, len(vertices))[tail]
    length = np.bincount(label, np.linalg.norm(vertices[head] - vertices[tail], axis=1))
    return len(np.unique(label)), float(length.max())


def _slivers(draft: repair.MeshEdit) -> list[Finding]:
    """Faces of three vertices in a line: they close the mesh, so they stay."""
    a, b, c = (draft.vertices[draft.faces[:, k]] for k in range(3))
    area2 = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    longest = np.max([np.sum((p - q) ** 2, axis=1) for p, q in ((a, b), (b, c), (c, a))], axis=0)
    thin = np.flatnonzero(area2 <= 1e-9 * longest)
    if not len(thin):
        return []
    words = f"{len(thin)} faces without area kept: they close the mesh"
    return [_finding(draft, words, thin, "", refused=False)]


def _overlaps(draft: repair.MeshEdit, across: Index, open: bool) -> list[Finding]:
    closed = bool(np.all(across >= 0))
    one, two, where = self_intersection.piercings(draft.vertices, draft.faces, closed)
    if not len(one):
        return []
    faces = draft.number[np.stack([one, two], axis=1).ravel()]
    return [
        Finding(
            f"the mesh passes through itself at {len(one)} places",
            where,
            faces,
            "noted" if open else "refused",
            "unite the parts in a mesh editor (boolean union), or open=True",
            crossing=True,
        )
    ]
