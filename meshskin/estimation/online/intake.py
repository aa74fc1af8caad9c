"""Frames of contact taken into a running estimate: what is left out and why, and what the belief
leaves open, which the contacts so far show.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np

from ...core.arrays import Array
from ...core.errors import CalibrationError, ContactError
from ...scene.belief import Belief
from ..data.measurements import Measurements
from ..data.resolve_belief import MODEL_SAMPLE
from .frames import ContactFrames, contacts_of, without_contacts
from .running_estimate import RunningEstimate

SURE = 20
"""Contacts up to which each one is looked at for what the belief leaves open: the median force of
so many is within a quarter of the spread of the forces."""
GROWTH = 1.5
"""Growth of the number of contacts from then on to the next look, of 5 ms."""
MAX_CHANGE, SETTLED_CHANGE = 0.1, 0.01
"""Relative change of the reference force, and of the priors and the nominal noise that follow it,
that is taken over; and the same where time does not press."""
IMPOSSIBLE = "without a finite point or a positive force"
OFF = "off the believed body"
OUTSIDE = "outside the range of the contact model"


class Intake:
    """Takes frames into a running estimate."""

    def __init__(self, belief: Belief) -> None:
        self.belief = belief
        self._left_out: Counter[str] = Counter()
        self._outside: list[tuple[ContactFrames, int, np.ndarray, Array]] = []
        """Frames outside the range of the contact model, of which another may hold, their numbers,
        and taxels and pressures of their readings."""
        self._next = 0

    @property
    def rejected(self) -> Counter[str]:
        """Numbers of the contacts left out, by reason."""
        return self._left_out + Counter({OUTSIDE: len(self._outside)})

    def start(self, frames: ContactFrames) -> RunningEstimate | None:
        """A running estimate with what the frames show; None without a contact among them. Raises
        as `without_contacts`."""
        usable = _usable(frames)
        if not usable.any():
            return None
        self._next = max(SURE, int(GROWTH * usable.sum())) if usable.sum() > SURE else 0
        return RunningEstimate(without_contacts(self.belief, frames.take(usable)))

    def take(
        self, estimate: RunningEstimate | None, frames: ContactFrames, number: int,
        readings: tuple[np.ndarray, np.ndarray, Array],
    ) -> RunningEstimate | None:  # fmt: skip
        """Add the frames, the first of `number`, with readings of frame, taxel, pressure (k,), Pa;
        the estimate, which the first contact starts."""
        usable = _usable(frames)
        self._left_out[IMPOSSIBLE] += int(np.sum((frames.force != 0) & ~usable))
        estimate = estimate or self.start(frames)
        if estimate is not None:
            self._add(estimate, frames, usable, number, readings)
            if estimate.store.count + len(self._outside) >= self._next:
                self.look(estimate)
        return estimate

    def _add(
        self, estimate: RunningEstimate, frames: ContactFrames, usable: np.ndarray, number: int,
        readings: tuple[np.ndarray, np.ndarray, Array],
    ) -> None:  # fmt: skip
        frame, taxel, pressure = readings
        block, valid, outside = contacts_of(estimate.store.template, frames, usable, number)
        self._left_out[OFF] += int(np.sum(usable & ~valid & ~outside))
        for k in np.flatnonzero(outside).tolist():
            mine = frame == k
            one = frames.take(slice(k, k + 1))
            self._outside.append((one, number + k, taxel[mine], pressure[mine]))
        if valid.any():
            row, read = np.cumsum(valid) - 1, valid[frame]
            estimate.add(block, (row[frame[read]], taxel[read], pressure[read]))

    def look(self, estimate: RunningEstimate, change: float = MAX_CHANGE) -> None:
        """Take over what the contacts so far show, where it changed by more than `change`: a
        contact model that holds in more of them, the reference force and what follows it."""
        store, now = estimate.store, estimate.store.template
        if now.learned:
            return
        count = store.count + len(self._outside)
        self._next = count + 1 if count < SURE else int(GROWTH * count)
        points, force = (
            np.concatenate(
                [store.columns[name].values, *(getattr(x[0], name) for x in self._outside)]
            )
            for name in ("points", "force")
        )
        some = slice(None, None, max(1, count // MODEL_SAMPLE))
        try:
            new = without_contacts(self.belief, ContactFrames(points[some], force[some]))
        except (CalibrationError, ContactError):  # that was found before serves on
            return
        if not store.noise_is_nominal:
            new = replace(new, noise=now.noise, noise_pairs=now.noise_pairs)
        moved = np.abs(np.log(_scales(new) / _scales(now))).max()
        if new.model == now.model and moved <= change:
            return
        estimate.refer(new)
        again, self._outside = self._outside, []
        for frame, number, taxel, pressure in again:
            first = np.zeros(len(taxel), dtype=int)
            self._add(estimate, frame, np.ones(1, dtype=bool), number, (first, taxel, pressure))


def _usable(frames: ContactFrames) -> np.ndarray:
    """Frames (B,) bool of contact."""
    finite = np.isfinite(frames.points).all(axis=1) & np.isfinite(frames.force)
    return np.asarray(finite & (frames.force > 0))


def _scales(data: Measurements) -> Array:
    """Reference force, noise, and standard deviations of the priors."""
    parameters = data.parameters
    own = [data.belief.force_reference or 1.0, data.sigma, *parameters.nuisance_sigma]
    return np.concatenate([own, parameters.sigma])
