"""The response of the contact force to a constant reference: settling, overshoot, error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa

from ..core import arrow
from ..core.arrays import Array
from ..core.errors import SimulationError
from ..recording.recording import Recording

SETTLING_BAND = 0.02
"""Error, relative to the reference, within which the force counts as settled: the usual 2 % band of
settling times. It must stay within until the contact point moves."""
MAX_DEPARTURE = 0.2
"""Error of the force after settling, relative to the reference, that is reported first."""
CONTROLLED_PHASES = ("touch", "hold", "slide")
"""Phases in which the law controls the force."""


@dataclass(frozen=True)
class ForceResponse:
    """The force after the first touch, against a constant reference."""

    reference: float
    """Reference force, N; the largest of several, to which the others' forces are scaled."""
    lighter: tuple[float, ...]
    """The other reference forces, N."""
    touch: float
    """Time of the first touch, s."""
    mean: float
    """Mean force after settling, N."""
    std: float
    """Standard deviation after settling, N."""
    overshoot: float
    """Largest force before the contact point moves, over the reference, minus one; at least 0."""
    settling: float
    """Time from the touch until the force stays within SETTLING_BAND, s; inf if the contact point
    moves before."""
    disturbance: float
    """Largest error while the contact point slides, relative to the reference; where it never
    slides, after settling."""
    lost: int
    """Steps without contact in which the law controls the force."""

    def metrics(self, departure: str) -> dict[str, Any]:
        """As in metrics.json; departure: in words as of `describe_departure`, or ""."""
        first: dict[str, Any] = {"departure": departure} if departure else {}
        if self.lighter:
            first["lighter_references_n"] = list(self.lighter)
        return first | {
            "reference_n": self.reference,
            "mean_n": self.mean,
            "std_n": self.std,
            "overshoot": self.overshoot,
            "settling_s": self.settling,
            "disturbance": self.disturbance,
            "lost_contact_steps": self.lost,
        }


def controlled_force(motion: pa.Table) -> tuple[Array, Array, Array, np.ndarray]:
    """Time, s, force and its reference, N, and phase (k,) of a simulated motion."""
    numbers = (arrow.values(motion.column(name)) for name in ("time", "force", "reference"))
    time, force, reference = numbers
    return time, force, reference, arrow.words(motion.column("phase"))


def describe_departure(recording: Recording) -> str:
    """When and where on the body the force of a simulated recording left its reference after
    settling, while the contact point slides, and what to change; "" where it stayed within
    MAX_DEPARTURE, and for contacts that are pressed one by one.
    """
    if (motion := recording.motion) is None:
        return ""
    time, force, references, phase = controlled_force(motion)
    after = phase == "slide"
    off = np.abs(force / references - 1.0)
    left = after & (off > MAX_DEPARTURE)
    if not left.any():
        return ""
    worst = int(np.argmax(np.where(left, off, 0.0)))
    lost = " (contact lost)" if force[worst] <= 0 else ""
    share = 100 * left.sum() / after.sum()
    place = ""
    if len(recording.time):
        nearest = recording.points[np.argmin(np.abs(recording.time - time[worst]))]
        place = f", near ({', '.join(f'{1e3 * x:.1f}' for x in nearest)}) mm of the body"
    return (
        f"the contact force left its reference after settling: {force[worst]:.3g} N{lost} instead "
        f"of {references[worst]:g} N at {time[worst]:.4g} s{place}, off by more than "
        f"{MAX_DEPARTURE:.0%} in {share:.2g} % of the steps; lower exploration.speed, "
        "raise law.gamma, or leave that bump or edge of the body out of the skin's region"
    )


def force_response(
    time: Array,
    force: Array,
    reference: float | Array,
    phase: Sequence[str] | np.ndarray | None = None,
) -> ForceResponse:
    """The response of a force (k,), N, at `time` (k,), s.

    reference: N, or (k,): each force is judged relative to its own. phase (k,): names of the
    exploration's phases; steps in the air between places are left out. Without it, all steps belong
    to one touch. Raises SimulationError without contact.
    """
    references = np.broadcast_to(reference, len(time))
    reference = float(references.max(initial=0.0))
    force = force * (reference / references)
    names = np.full(len(time), CONTROLLED_PHASES[0]) if phase is None else np.asarray(phase)
    controlled = np.isin(names, CONTROLLED_PHASES)
    t, f, names = time[controlled], force[controlled], names[controlled]
    contact = np.flatnonzero(f > 0)
    if not len(contact):
        raise SimulationError("the recording has no contact force", remedy="check the indenter")
    t, f, names = t[contact[0] :], f[contact[0] :], names[contact[0] :]
    sliding = np.flatnonzero(names == "slide")
    resting = int(sliding[0]) if len(sliding) else len(f)
    outside = np.flatnonzero(np.abs(f[:resting] - reference) > SETTLING_BAND * reference)
    first = int(outside[-1]) + 1 if len(outside) else 0
    settles = first < resting
    settled = f[first:] if settles else f
    counted = f[names == "slide"] if resting < len(f) else settled
    return ForceResponse(
        reference=reference,
        lighter=tuple(np.unique(references[references < reference]).tolist()),
        touch=float(t[0]),
        mean=float(settled.mean()),
        std=float(settled.std()),
        overshoot=max(float(f[:resting].max(initial=0.0)) / reference - 1.0, 0.0),
        settling=float(t[first] - t[0]) if settles else float("inf"),
        disturbance=float(np.abs(counted / reference - 1.0).max()),
        lost=int(np.count_nonzero(f == 0)),
    )
