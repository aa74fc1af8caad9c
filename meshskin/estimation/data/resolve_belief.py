"""What a belief leaves to the recording: the reference force, and the contact model that holds."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from ... import contact
from ...core.arrays import Array
from ...core.errors import CalibrationError, ContactError
from ...recording.recording import Recording
from ...scene.belief import Belief
from .global_parameters import LEARNED_ONLY

MAX_INVALID = 0.05
"""Largest fraction of the contacts that may be outside the contact model's range: those are left
out. Chosen: a few edges or peaks of the force; more is a model that does not suit the recording."""
ROUND = 0.01, 1.02
"""Share of the contacts whose relative principal curvatures may have more than this ratio where the
mean of a learned response has round patches. Hertz' contact holds up to larger ones within its
error, but ovals then pass for lags of single taxels: on an ellipsoid with a ratio of 1.04 taxels
that spirals cross were 0.16 mm off, with ellipses 0.02 (noise of 1 %)."""
MODEL_SAMPLE = 500
"""Contacts, evenly spread over the recording, that choose the contact model: of a twentieth outside
the range, MAX_INVALID, it sees 25."""


def resolve_belief(belief: Belief, recording: Recording) -> Belief:
    """The belief with a reference force and a contact model.

    A missing reference force is the median force of the recording; contact "auto" becomes the first
    model that holds in the recording's contacts. Raises ContactError, of the most general model,
    where none does; with "learned", too, where the widest model then serves as its mean.
    CalibrationError if parameters of a learned response are declared unknown with another model.
    """
    own = [name for name in belief.unknown if name in LEARNED_ONLY]
    if own and belief.contact != contact.LEARNED:
        raise CalibrationError(
            f"{', '.join(own)} cannot be unknown with this contact model",
            value=f'contact="{belief.contact}"',
            remedy='believe contact="learned", which estimates what the readings show of them',
        )
    pressed = recording.force > 0
    if belief.force_reference is None:
        force = recording.force[pressed]
        belief = replace(belief, force_reference=float(np.median(force)) if len(force) else 1.0)
    if belief.contact not in (contact.AUTO, contact.LEARNED):
        return belief
    rows = np.flatnonzero(pressed)
    rows = rows[:: max(1, len(rows) // MODEL_SAMPLE)]
    curvature = belief.body.closest(recording.points[rows]).curvature
    if belief.contact == contact.LEARNED:
        relative = curvature + 1 / belief.indenter.radius
        unequal = np.mean(relative[:, 0] > ROUND[1] * relative[:, 1]) if len(rows) else 0.0
        with suppress(ContactError):
            found = with_valid_model(belief, recording.force[rows], curvature)
            if found.contact != "hertz" or unequal <= ROUND[0]:
                return found
        return replace(belief, contact="elliptic")
    return with_valid_model(belief, recording.force[rows], curvature)


def contact_model(belief: Belief) -> contact.ContactModel:
    """The contact model of a belief that names one of contact.BATCHED."""
    return contact.ContactModel(belief.contact, belief.material.poisson, belief.material.thickness)


def with_valid_model(belief: Belief, force: Array, curvature: Array) -> Belief:
    """The belief with the first contact model that holds under forces (m,), N, at principal
    curvatures (m, 2), 1/m.

    Raises ContactError, of the most general model, where none does.
    """
    *others, last = (
        replace(belief, contact=name)
        for name in contact.BATCHED
        if name != "layered" or belief.material.thickness is not None
    )
    for candidate in others:
        with suppress(ContactError):
            valid_contacts(force, curvature, candidate)
            return candidate
    valid_contacts(force, curvature, last)
    return last


def valid_contacts(force: Array, curvature: Array, belief: Belief) -> np.ndarray:
    """Contacts (m,) bool that are in the range of the contact model.

    Raises the ContactError of the widest contact outside it, where more than MAX_INVALID of them
    are.
    """
    material, valid = belief.material, in_range(contact_model(belief), belief, force, curvature)
    invalid = np.flatnonzero(~valid)
    if len(invalid) > MAX_INVALID * len(valid):
        relative = np.maximum(curvature[invalid].mean(axis=1) + 1 / belief.indenter.radius, 0.0)
        widest = invalid[np.argmax(force[invalid] * relative**2)]  # increases with a/R
        contact.solve(
            belief.contact,
            force=float(force[widest]),
            curvature=tuple(curvature[widest]),
            indenter_radius=belief.indenter.radius,
            modulus=material.young,
            poisson=material.poisson,
            thickness=material.thickness,
        )
    return valid


def in_range(
    model: contact.ContactModel,
    belief: Belief,
    force: Array,
    curvature: Array,
    modulus: float | None = None,
) -> np.ndarray:
    """Contacts (m,) bool at which the model holds; arguments as `nominal_patches`."""
    return model.is_valid(**_loads(belief, force, curvature, modulus))


def nominal_patches(
    model: contact.ContactModel,
    belief: Belief,
    force: Array,
    curvature: Array,
    modulus: float | None = None,
) -> contact.Patches:
    """Patches of forces (m,), N, at curvatures (m, 2), 1/m, and E*, Pa, by default the nominal."""
    return model.patches(**_loads(belief, force, curvature, modulus))


def _loads(belief: Belief, force: Array, curvature: Array, modulus: float | None) -> dict[str, Any]:
    """The arguments of a contact model under a belief."""
    return {
        "force": force,
        "curvature": curvature,
        "indenter_radius": belief.indenter.radius,
        "effective_modulus": belief.material.effective_modulus if modulus is None else modulus,
    }
