"""What a belief leaves to the recording: the usual force, the contact model that holds in it."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ... import contact
from ...core.errors import ContactError
from ...core.se3 import Array

if TYPE_CHECKING:
    from ...recording.recording import Recording
    from ...scene.belief import Belief

MOST_OUT = 0.05
"""Part of the contacts that may leave the contact model's range; they are left out."""
SOME = 500
"""Contacts, evenly, that choose the model."""


def resolve_belief(belief: Belief, recording: Recording) -> Belief:
    """The belief with the recording's median force as its reference, where it has none, and for
    "auto" with the first contact model that holds in the recording's contacts.

    Raises ContactError, of the most general model, where none does.
    """
    pressed = recording.force > 0
    if belief.force_reference is None:
        force = recording.force[pressed]
        belief = replace(belief, force_reference=float(np.median(force)) if len(force) else 1.0)
    if belief.contact != contact.AUTO:
        return belief
    rows = np.flatnonzero(pressed)
    rows = rows[:: max(1, len(rows) // SOME)]
    if not len(rows):
        return replace(belief, contact=contact.BATCHED[0])
    curvature = belief.body.closest(recording.points[rows]).curvature
    *others, last = (
        replace(belief, contact=name)
        for name in contact.BATCHED
        if name != "layered" or belief.material.thickness is not None
    )
    for chosen in others:
        with suppress(ContactError):
            valid_contacts(recording.force[rows], curvature, chosen)
            return chosen
    valid_contacts(recording.force[rows], curvature, last)
    return last


def valid_contacts(force: Array, curvature: Array, belief: Belief) -> np.ndarray:
    """In which contacts (m,) the contact model holds: all, or all but `MOST_OUT` of them.

    Raises the ContactError of the widest that leaves its range, where more do.
    """
    material = belief.material
    holds = contact.ContactModel(belief.contact, material.poisson, material.thickness).is_valid(
        force=force,
        curvature=curvature,
        indenter_radius=belief.indenter.radius,
        effective_modulus=material.effective_modulus,
    )
    out = np.flatnonzero(~holds)
    if len(out) > MOST_OUT * len(holds):
        relative = np.maximum(curvature[out].mean(axis=1) + 1 / belief.indenter.radius, 0.0)
        worst = out[np.argmax(force[out] * relative**2)]  # rises with a/R
        contact.solve(
            belief.contact,
            force=float(force[worst]),
            curvature=tuple(curvature[worst]),
            indenter_radius=belief.indenter.radius,
            modulus=material.young,
            poisson=material.poisson,
            thickness=material.thickness,
        )
    return holds
