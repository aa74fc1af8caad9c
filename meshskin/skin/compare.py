"""Comparison of two skins: their alignment, and a permutation of ids that explains differences.

A file of module frames (a URDF of iCub) is compared with the modules of a file of taxels.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ..core.arguments import check_integer, check_type
from ..core.arrays import Array, means_by_group, neighbour_distances
from ..core.errors import SkinError
from . import slots
from .files.table import LAST_DIGIT
from .pairing import Pairing, distances, pair, pairing_by_id
from .skin import Skin
from .slots import Ids

TAXEL_RATIO = 0.9
"""Taxels are paired one by one, instead of by modules, if their mean distance is below this part of
that of the modules: single taxels always fit a little better."""
EXPLAINED = 0.5
"""A permutation explains a difference if it leaves at most this part of the rms distance."""
MIN_TAXELS = 3
"""Least mean number of ids in a module of a skin of taxels; modules of iCub have 10 or 12."""
MIN_RESHAPED = 6
"""Taxels, at least, that show a mirror or a scale: 18 coordinates for 8 unknowns."""
MIN_MOVED = 20
"""Number of permuted taxels from which on they are described by modules, if they moved with them:
two modules."""


@dataclass(frozen=True, eq=False)
class Reshape:
    """How B is mirrored and scaled with regard to A."""

    pose: Array
    """(4, 4) that brings B to A: a rotation, times `scale`, mirrored where `mirror` says so"""
    scale: float = 1.0
    """size of B in relation to A"""
    mirror: Array | None = None
    """(3,) unit vector in B's frame along which it is mirrored; None: it is not"""

    def __str__(self) -> str:
        parts = []
        if self.mirror is not None:
            along = ", ".join(f"{round(x, 2) + 0.0:.2f}" for x in self.mirror)
            parts.append(f"mirrored along ({along})")
        if self.scale != 1.0:
            parts.append(f"scaled by {self.scale:.5g}")
        return "B is A " + " and ".join(parts)


@dataclass(frozen=True, eq=False)
class Difference:
    """Differences between skins A and B; distances in m.

    Where one of them is a skin of module frames, "taxel" means the frame of a module, and ids are
    numbers of modules: `by_modules` says so.
    """

    ids: Ids
    """(n,) ids of taxels in both"""
    only_a: Ids
    """(k,) ids of taxels only in A"""
    only_b: Ids
    """(l,) ids of taxels only in B"""
    unaligned: Array
    """(n,) distance of each taxel to that of the same id"""
    alignment: Array
    """(4, 4) T_a_b that aligns B with A"""
    aligned: Array
    """(n,) distance of each taxel to that of the same id after the alignment"""
    unit: str
    """what was paired: "module" or "taxel" """
    permutation: dict[int, int]
    """units paired with one of another number: number in A -> number in B; empty unless that
    removes at least half of the difference"""
    paired_ids: Ids
    """(p,) ids in A of the taxels whose unit has a partner in B"""
    paired: Array
    """(p,) their distances after alignment and permutation"""
    reshape: Reshape | None = None
    """mirror and scale of B that remove at least half of the difference"""
    reshaped: Array = field(default_factory=lambda: np.empty(0))
    """(n,) distance of each taxel to that of the same id after the alignment and these"""
    frames: str = ""
    """the skin whose taxels are frames of modules, "A" or "B"; empty if neither is"""

    @property
    def by_modules(self) -> bool:
        """Whether ids are numbers of modules, because one skin is of module frames."""
        return bool(self.frames)

    def sentences(self) -> tuple[str, ...]:
        """The permutation in words: exchanges, cycles, renumbered units."""
        return words(self.permutation, self.unit)

    def worst(self, count: int = 10) -> list[tuple[int, float]]:
        """Ids and distances (m) of the worst taxels after alignment and permutation.

        Raises ConfigError for a negative count.
        """
        count = check_integer("count of the worst taxels", count, least=0)
        order = np.argsort(-self.paired, kind="stable")[:count]
        return [(int(self.paired_ids[k]), float(self.paired[k])) for k in order]


def rms(values: Array) -> float:
    """Root mean square; 0 for an empty array."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0


def compare(a: Skin, b: Skin) -> Difference:
    """The differences between skins A and B, with the alignment and a permutation of ids.

    Taxels without a position are ignored. If the ids of one skin are the numbers of the other's
    modules, modules are compared, each at its slot 3 (or the mean of its taxels). Raises SkinError
    where a skin has fewer than 3 taxels.
    """
    (ids_a, at_a), (ids_b, at_b) = _positions(a, "A"), _positions(b, "B")
    frames_a, frames_b = _is_frames(ids_a, ids_b), _is_frames(ids_b, ids_a)
    if frames_a:
        ids_b, at_b = module_centres(ids_b, at_b)
    elif frames_b:
        ids_a, at_a = module_centres(ids_a, at_a)
    by_modules = frames_a or frames_b
    ids, rows_a, rows_b = np.intersect1d(ids_a, ids_b, return_indices=True)
    before = np.linalg.norm(at_a[rows_a] - at_b[rows_b], axis=1)
    taxels = pair(ids_a, at_a, ids_b, at_b, 1)
    modules = None if by_modules else pair(ids_a, at_a, ids_b, at_b, slots.PER_MODULE)
    assert taxels is not None
    best = taxels
    if modules is not None and _as_close(modules, taxels, at_a, at_b):
        best = modules
    own = pairing_by_id(at_a, at_b, rows_a, rows_b)
    if own is not None and best.moved and not _removes_half(own, best, ids_a, at_a, at_b):
        best = own
    after = distances(best.pose, at_a[rows_a], at_b[rows_b])
    reshape = reshape_of(at_a[rows_a], at_b[rows_b])
    if reshape is not None:
        left = distances(reshape.pose, at_a[rows_a], at_b[rows_b])
        permuted = rms(best.distances(at_a, at_b))
        if best.moved and own is not None and rms(left) <= permuted:
            best, after = own, distances(own.pose, at_a[rows_a], at_b[rows_b])
        elif best.moved:
            reshape = None
    off = best.distances(at_a, at_b)
    return Difference(
        ids,
        np.setdiff1d(ids_a, ids_b),
        np.setdiff1d(ids_b, ids_a),
        before,
        best.pose,
        after,
        "taxel" if best.size == 1 and not by_modules else "module",
        best.moved,
        ids_a[best.rows_a],
        off,
        reshape,
        np.empty(0) if reshape is None else left,
        "A" if frames_a else "B" if frames_b else "",
    )


def reshape_of(at_a: Array, at_b: Array) -> Reshape | None:
    """Mirror and scale that bring points B (n, 3), m, to A; None where they leave more than half of
    the rms distance after a rigid alignment, or of the rms radius of A: any points shrink to one,
    which is no farther from A than that.

    Source: Umeyama, IEEE PAMI 13 (1991).
    """
    if len(at_a) < MIN_RESHAPED:
        return None
    a, b = at_a - at_a.mean(axis=0), at_b - at_b.mean(axis=0)
    u, _, vt = np.linalg.svd(a.T @ b)
    proper = float(np.sign(np.linalg.det(u @ vt)))
    found = []
    for sign in (1.0, -1.0):
        turn = u @ np.diag([1.0, 1.0, sign * proper]) @ vt
        factor = float(np.sum(a * (b @ turn.T)) / np.sum(b**2))
        for scale in (1.0, factor):
            left = rms(np.linalg.norm(a - scale * b @ turn.T, axis=1))
            found.append((left, sign, scale, turn))
    rigid, least = found[0][0], min(fit[0] for fit in found)
    to_explain = min(rigid, rms(np.linalg.norm(a, axis=1)))
    if to_explain <= LAST_DIGIT or least > EXPLAINED * to_explain:
        return None
    limit = max(least / EXPLAINED, LAST_DIGIT)  # the simplest of those that fit as well
    _, sign, scale, turn = next(fit for fit in found if fit[0] <= limit)
    pose = np.eye(4)
    pose[:3, :3] = scale * turn
    pose[:3, 3] = at_a.mean(axis=0) - pose[:3, :3] @ at_b.mean(axis=0)
    value, vectors = np.linalg.eig(turn)
    mirror = np.real(vectors[:, np.argmin(np.abs(value + 1.0))]) if sign < 0 else None
    if mirror is not None:
        mirror = mirror * np.sign(mirror[np.argmax(np.abs(mirror))])
    return Reshape(pose, 1 / scale, mirror)


def module_centres(ids: Ids, at: Array) -> tuple[Ids, Array]:
    """Numbers (m,) and centres (m, 3) of the modules of taxels with sorted ids at `at` (n, 3).

    The centre is slot 3, the origin of the module's frame; without it the mean of the taxels.
    """
    numbers, index = np.unique(slots.module(ids), return_inverse=True)
    centres = means_by_group(at, index)
    origin = slots.slot(ids) == slots.CENTRE
    centres[index[origin]] = at[origin]
    return numbers, centres


def _is_frames(ids: Ids, others: Ids) -> bool:
    """Whether `ids` are numbers of the modules of a skin of taxels with the ids `others`.

    At least half of them are, and more of them than are ids of its taxels; or some would be thermal
    pads, of which it has none.
    """
    numbers = np.unique(slots.module(others))
    if len(others) < MIN_TAXELS * len(numbers) or len(numbers) < 3:
        return False
    share = float(np.isin(ids, numbers).mean())
    thermal = [bool(np.isin(slots.slot(i), slots.THERMAL).any()) for i in (ids, others)]
    more = share > float(np.isin(ids, others).mean())
    return share >= 0.5 and (more or thermal == [True, False])


def _as_close(modules: Pairing, taxels: Pairing, at_a: Array, at_b: Array) -> bool:
    """Whether pairing modules fits as closely as pairing taxels one by one: over all units, or over
    the pairs alone, if it pairs as many taxels.
    """
    if modules.score <= taxels.score / TAXEL_RATIO + 1e-9:
        return True
    if len(modules.rows_a) < len(taxels.rows_a):
        return False
    one, other = (float(pairs.distances(at_a, at_b).mean()) for pairs in (modules, taxels))
    return one <= other / TAXEL_RATIO + 1e-9


def _removes_half(own: Pairing, other: Pairing, ids: Ids, at_a: Array, at_b: Array) -> bool:
    """Whether the pairing `other` leaves at most half of the rms distance of the pairing by id.

    Over the taxels of A that either of them pairs; one that is not paired counts as being one
    spacing away.
    """
    units = module_centres(ids, at_a)[1] if other.size > 1 else at_a
    spacing = float(np.median(neighbour_distances(units)))
    left = []
    for pairing in (own, other):
        distance = np.full(len(at_a), spacing)
        distance[pairing.rows_a] = pairing.distances(at_a, at_b)
        left.append(rms(distance[np.union1d(own.rows_a, other.rows_a)]))
    return left[1] <= EXPLAINED * left[0]


def _positions(skin: Skin, name: str) -> tuple[Ids, Array]:
    """Sorted ids and positions (n, 3) of the taxels that have a position. Raises SkinError."""
    check_type(Skin, skin, f"skin {name}")
    order = np.argsort(skin.ids, kind="stable")
    order = order[np.isfinite(skin.positions[order]).all(axis=1)]
    ids = np.asarray(skin.ids[order], dtype=np.int64)
    if len(ids) < 3:
        raise SkinError(f"skin {name} has too few taxels", value=len(ids), limit="at least 3")
    return ids, np.asarray(skin.positions[order])


def words(permutation: dict[int, int], unit: str) -> tuple[str, ...]:
    """Exchanges, cycles and chains of a permutation of units ("module" or "taxel") from A to B.

    Taxels that moved with their modules are described by modules, and by permutations of slots.
    """
    if unit == "taxel" and len(permutation) >= MIN_MOVED:
        return _by_modules(permutation) or _by_units(permutation, unit)
    return _by_units(permutation, unit)


def _by_modules(permutation: dict[int, int]) -> tuple[str, ...]:
    """Sentences by modules; none if the taxels of a module did not move together."""
    slot_maps: dict[int, dict[int, int]] = {}
    targets: dict[int, set[int]] = {}
    for before, after in sorted(permutation.items()):
        module, slot = divmod(before, slots.PER_MODULE)
        targets.setdefault(module, set()).add(after // slots.PER_MODULE)
        slot_maps.setdefault(module, {})[slot] = after % slots.PER_MODULE
    if any(slot in slots.THERMAL for m in slot_maps.values() for slot in (*m, *m.values())):
        return ()  # taxels without modules
    if any(len(found) > 1 for found in targets.values()):
        return ()
    target = {module: found.pop() for module, found in targets.items()}
    patterns: dict[tuple[tuple[int, int], ...], list[int]] = {}
    for module, slot_map in slot_maps.items():
        same = {} if target[module] != module else {s: s for s in slots.TAXELS if s not in slot_map}
        patterns.setdefault(tuple(sorted((same | slot_map).items())), []).append(module)
    if len(patterns) > 0.5 * len(slot_maps):
        return ()
    moved = {module: number for module, number in target.items() if module != number}
    sentences = list(_by_units(moved, "module")) if moved else []
    for pattern, modules in patterns.items():
        if all(one == two for one, two in pattern):
            continue
        from_slots, to_slots = (" ".join(map(str, end)) for end in zip(*pattern, strict=True))
        where = ", ".join(map(str, modules))
        sentences.append(f"slots {from_slots} are slots {to_slots} of B in modules {where} of A")
    return tuple(sentences)


def _by_units(permutation: dict[int, int], unit: str) -> tuple[str, ...]:
    """Sentences by units: a common shift, or exchanges, cycles and chains."""
    shifts = {after - before for before, after in permutation.items()}
    if len(permutation) > 2 and len(shifts) == 1:
        shift = shifts.pop()
        return (
            f"{unit} numbers of B are those of A {'plus' if shift > 0 else 'minus'} {abs(shift)}",
        )
    remaining, sentences = dict(permutation), []
    targets = set(remaining.values())
    for number in sorted(remaining, key=lambda n: (n in targets, n)):  # chains first
        if number not in remaining:
            continue
        chain = [number]
        while chain[-1] in remaining:
            chain.append(remaining.pop(chain[-1]))
        closed = chain[0] == chain[-1]
        if len(chain) == 2:
            sentences.append(f"{unit} {chain[0]} of A is {unit} {chain[1]} of B")
        elif closed and len(chain) == 3:
            sentences.append(f"{unit}s {chain[0]} and {chain[1]} exchanged")
        else:
            done = "permuted" if closed else "renumbered"
            sentences.append(f"{unit}s {done}: {' -> '.join(map(str, chain))} (A -> B)")
    return tuple(sentences)
