"""The result of a recalibration: the state of every module and taxel, and the updated map."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from ...core import se3
from ...core.arguments import check_integer
from ...core.arrays import Array
from ...core.notebook import Card
from ...core.progress import Progress
from ...core.value import Value
from ...scene.belief import Belief
from ..calibration import Calibration
from ..chart import align_normals
from ..result import join_words
from .errors import Errors
from .evidence import Evidence
from .hypotheses import (
    CONFIRMED,
    DEAD,
    EXCHANGED,
    GAIN,
    MOVED,
    NOT_TOUCHED,
    STATES,
    TURNED,
    UNDECIDED,
)
from .skin_map import SkinMap, amplification
from .touch_design import TouchDesign

SHOWN = 20
"""Ids of one state that the text lists."""

FACTOR = "earlier map, tested by {} touches: {} changes"
"""What the updated map is made of."""


@dataclass(frozen=True)
class Finding:
    """One change of a module or of a taxel."""

    unit: str
    """"module" or "taxel"."""
    number: int
    """Its number or id."""
    state: str
    """What became of it, one of `hypotheses.STATES`."""
    words: str
    """The state with its values, in words."""
    evidence: float
    """log10 of the mean likelihood ratio of the changes to no change."""
    false_alarm: float
    """Bound on the probability of an alarm so strong, in any unit, if none changed."""

    def __str__(self) -> str:
        return (
            f"{self.unit} {self.number}: {self.words} (evidence 10^{self.evidence:.0f}, false "
            f"alarm below {self.false_alarm:.1g})"
        )


@dataclass(frozen=True, eq=False)
class Recalibration(Value, Card):
    """What the touches of a recording say of an earlier map."""

    calibration: Calibration
    """The map with the changes that were found; the other taxels keep their places."""
    findings: tuple[Finding, ...]
    """The changes that were found."""
    units: np.ndarray
    """Numbers (u,) of the modules, or ids of the taxels where there are no modules."""
    unit: str
    """What a unit is: "module" or "taxel"."""
    unit_states: np.ndarray
    """State (u,) of each unit, one of `hypotheses.STATES`."""
    unit_evidence: Array
    """log10 (u,) of the evidence of a change: of the first one found, or of the strongest."""
    placed: np.ndarray
    """(u,) bool: whether a move of the unit by 2 mm, in any direction, is excluded."""
    ids: np.ndarray
    """Taxel ids (n,), ascending."""
    states: np.ndarray
    """State (n,) of each taxel; "not touched" where the touches do not show it."""
    false_alarm: float
    """Probability, at most, that any change is found where nothing changed."""
    errors: Errors
    """Errors of the readings, estimated from the touches."""
    peak: float
    """Typical peak pressure, Pa, to which the errors are relative."""
    contacts: int
    """Number of touches used."""

    def __repr__(self) -> str:
        parts = _counted(self.unit_states)
        return f"<Recalibration by {self.contacts} touches: {self.unit}s {parts}>"

    def __str__(self) -> str:
        return "\n".join(self.lines())

    def lines(self, shown: int | None = SHOWN) -> list[str]:
        """The result in words, a line each; lists of at most `shown` ids (None: all).

        Raises ConfigError for a negative number.
        """
        shown = None if shown is None else check_integer("shown", shown, least=0)
        e, count = self.errors, len(self.units)
        out = [
            f"{self.contacts} touches of {count} {self.unit}s; false alarms: at most "
            f"{self.false_alarm:.2g} for the whole map",
            f"errors of the readings: {e.sigma:.2%} of the peak and {e.rho:.2%} of the reading, "
            f"touches {1e3 * e.tau:.2g} mm; E* {np.exp(e.log_modulus):.3g} and scale "
            f"{np.exp(e.log_scale):.3g} times those of the map",
        ]
        out += [str(finding) for finding in self.findings]
        for state in (CONFIRMED, UNDECIDED, NOT_TOUCHED):
            numbers = self.units[self.unit_states == state]
            if len(numbers):
                out.append(f"{state}: {_listed(self.unit, numbers, shown)}")
        sure = self.unit_states == CONFIRMED
        if sure.any():
            open_ = self.units[sure & ~self.placed]
            words = f"confirmed {self.unit}s are not turned, exchanged or dead, nor moved by 2 mm"
            out.append(
                words + (f", but for {_listed(self.unit, open_, shown)}" if len(open_) else "")
            )
        if self.unit == "module":
            out.append(f"taxels: {_counted(self.states)}")
        return out

    def facts(self) -> dict[str, str]:
        """Touches, states and findings, for a notebook."""
        facts = {"touches": f"{self.contacts:,}", f"{self.unit}s": _counted(self.unit_states)}
        if self.unit == "module":
            facts["taxels"] = _counted(self.states)
        return facts | {f"{f.unit} {f.number}": f.words for f in self.findings[:SHOWN]}

    def metrics(self) -> dict[str, Any]:
        """The result as JSON values."""
        return {
            "contacts": self.contacts,
            "false_alarm": self.false_alarm,
            "findings": [vars(finding) for finding in self.findings],
            self.unit + "s": {
                str(number): state
                for number, state in zip(self.units, self.unit_states, strict=True)
            },
            "taxels": {
                str(number): state for number, state in zip(self.ids, self.states, strict=True)
            },
        }

    def next_contacts(
        self, k: int = 10, belief: Belief | None = None, progress: Progress | None = None
    ) -> TouchDesign:
        """The k touches that test best what these left open, or the whole map where they left
        nothing (touch_design.py); errors as `next_touches`."""
        from .touch_design import next_touches

        settled = ~np.isin(self.unit_states, (UNDECIDED, NOT_TOUCHED)) & self.placed
        open_ = self.units[~settled]
        units = open_ if len(open_) else None
        return next_touches(self.calibration, belief, k, units, progress)


def _counted(states: np.ndarray) -> str:
    """How many there are of each state, in words."""
    count = Counter(states.tolist())
    return ", ".join(f"{count[s]} {s}" for s in STATES if count[s])


def _listed(unit: str, numbers: np.ndarray, shown: int | None) -> str:
    plural = "s" if len(numbers) > 1 else ""
    names = ", ".join(map(str, numbers[:shown]))
    more = "" if shown is None or len(numbers) <= shown else f" and {len(numbers) - shown} more"
    return f"{len(numbers)} {unit}{plural} ({names}{more})"


def updated(
    known: SkinMap, belief: Belief, found: list[Evidence], findings: tuple[Finding, ...],
    contacts: int,
) -> Calibration:  # fmt: skip
    """The calibration with the taxels of changed units at their new places, and faults named."""
    base, n = known.calibration, len(known.ids)
    poses, source, moves = known.poses.copy(), np.arange(n), np.zeros((n, 3, 3))
    gain = np.stack([known.log_gain[:, 0], np.full(n, np.nan)], axis=1)
    faults = np.full(n, "", dtype=object) if base.faults is None else base.faults.astype(object)
    touched = np.zeros(n, dtype=bool)
    for rows, evidence in zip(known.units, found, strict=True):
        touched[rows] = evidence.touched
        for change in evidence.changes:
            h = change.hypothesis
            mine = rows if h.taxel < 0 else rows[h.taxel : h.taxel + 1]
            if h.state in (TURNED, EXCHANGED):  # the places are those of other taxels of the map
                placed = np.flatnonzero(known.known)
                source[rows] = placed[cKDTree(known.points[placed]).query(h.points)[1]]
            if h.state in (TURNED, EXCHANGED, MOVED):
                rotation = align_normals(known.poses[source[rows], :3, :3], h.normals)
                poses[rows] = se3.transform(rotation, evidence.state.points)
            if h.state == MOVED:
                moves[rows] += change.shift_covariance
            if h.state == GAIN:
                gain[mine, 0] += change.log_gain
                gain[mine, 1] = change.log_gain_sigma
            if h.state in (DEAD, GAIN):
                words = h.state if h.state == DEAD else f"gain times {np.exp(change.log_gain):.2f}"
                faults[mine] = [join_words(f, words) for f in faults[mine]]
    filled = known.known & ~np.isfinite(base.positions[:, 0])
    return replace(
        base,
        poses=poses,
        covariances=_covariances(known, poses, source, moves),
        observed=(base.observed | filled[:, None])[source],
        touched=base.touched | (touched & ~base.readings.any()),
        reasons=np.where(filled, "", base.reasons).astype(object),
        faults=faults,
        contact_centroids=None,
        iterates=None,
        factors=(*base.factors, FACTOR.format(contacts, len(findings))),
        taxel_unknowns=_taxel_unknowns(known, gain),
        belief=replace(base.belief or belief, taxel_ids=known.ids),
    )


def _taxel_unknowns(known: SkinMap, gain: Array) -> Mapping[str, Array]:
    """Those of the map, with the ln gains (n, 2) and their standard deviations, NaN where they are
    as they were."""
    base, before = known.calibration, known.calibration.taxel_unknowns.get("gain")
    if before is None and np.array_equal(gain[:, 0], known.log_gain[:, 0]):
        return base.taxel_unknowns
    gain = gain / amplification(base)[:, None]
    old = np.zeros(len(gain)) if before is None else before[:, 1]
    gain[:, 1] = np.where(np.isnan(gain[:, 1]), old, gain[:, 1])
    return {**base.taxel_unknowns, "gain": gain}


def _covariances(known: SkinMap, poses: Array, source: np.ndarray, moves: Array) -> Array:
    """(n, 6, 6) in the taxels' frames: those of the taxels (n,) of the map at whose places they are
    now, with `poses` (n, 4, 4), and what `moves` add (n, 3, 3), body frame, m^2."""
    out = np.array(known.calibration.covariances)
    before, after = known.poses[:, :3, :3], poses[:, :3, :3]
    out[:, :3, :3] = np.swapaxes(before, 1, 2) @ known.covariance @ before
    out = out[source]
    out[:, :3, :3] += np.swapaxes(after, 1, 2) @ moves @ after
    out[~known.known & ~np.isfinite(poses[:, 0, 3])] = np.diag([np.inf] * 6)
    return out
