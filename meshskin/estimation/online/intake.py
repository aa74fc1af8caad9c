"""What comes in: beliefs that can be estimated online, and contacts of new frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ... import contact
from ...core.arrays import Array
from ...core.errors import CalibrationError
from ...scene.belief import Belief
from ..calibration import Calibration
from ..data import unit_checks
from ..data.global_parameters import declared_parameters
from ..data.measurements import NOMINAL_NOISE, Measurements, nominal_patches
from ..data.resolve_belief import resolve_belief
from .frames import ContactFrames


def checked_belief(belief: Belief, previous: Calibration | None) -> Belief:
    """The belief, with the noise of `previous` where it has none. Raises CalibrationError."""
    if not hasattr(belief, "taxel_ids"):
        raise CalibrationError(
            "no belief", value=type(belief).__name__,
            remedy="give what the robot's owner knows: scene.belief()",
        )  # fmt: skip
    remedy = "collect a recording and use ms.calibrate"
    if belief.readings != "pressure" or belief.contact == contact.LEARNED:
        value = f'readings="{belief.readings}", contact="{belief.contact}"'
        raise CalibrationError(
            "a learned response cannot be estimated online", value=value, remedy=remedy
        )
    for name in ("module_slots", "contact_motion"):
        if getattr(belief, name) is not None:
            raise CalibrationError(
                f"{name} cannot be estimated online", value=f"belief.{name}",
                remedy=f"{remedy}, or leave {name} out",
            )  # fmt: skip
    if not len(belief.taxel_ids):
        raise CalibrationError("an online calibration needs the ids of the taxels",
                               remedy="give belief.taxel_ids")  # fmt: skip
    fit = None if previous is None else previous.fit
    if belief.noise_sigma is not None or fit is None or not fit.noise > 0:
        return belief
    return replace(belief, noise_sigma=fit.noise)


def without_contacts(belief: Belief, frames: ContactFrames) -> Measurements:
    """Measurements without contacts, with the reference force, the contact model and the nominal
    noise that the first `frames` show where the belief leaves them open.

    Raises CalibrationError for frames far from the body, ContactError where no model holds.
    """
    hit = belief.body.closest(frames.points)
    unit_checks.check_points(belief.body, frames.points, hit.distance)
    belief = resolve_belief(belief, frames)  # type: ignore[arg-type]
    material = belief.material
    model = contact.ContactModel(belief.contact, material.poisson, material.thickness)
    patches = nominal_patches(model, belief, frames.force, hit.curvature)
    reference, peak = belief.force_reference or 1.0, float(np.median(patches.peak))
    empty, saturation = np.empty(0, dtype=int), belief.saturation or np.inf
    headings = np.empty((0, 3, 3)) if "indenter_offset" in belief.unknown else None
    return Measurements(
        belief=belief,
        points=np.empty((0, 3)),
        normals=np.empty((0, 3)),
        directions=np.empty((0, 3)),
        curvature=np.empty((0, 2)),
        force=np.empty(0),
        patches=patches.take(empty),
        model=model,
        contact=empty,
        taxel=empty,
        pressure=np.empty(0),
        noise=belief.noise_sigma or NOMINAL_NOISE * peak,
        threshold=belief.threshold,
        saturation=saturation,
        ends=np.full(len(belief.taxel_ids), saturation),
        parameters=declared_parameters(belief.unknown, belief.priors, reference, peak),
        headings=headings,
    )


def contacts_of(
    template: Measurements, frames: ContactFrames, pressed: np.ndarray
) -> tuple[Measurements, np.ndarray]:
    """The contacts of the frames `pressed` (B,) bool that are on the body and in the range of the
    contact model, and which (B,) bool of the frames these are; `template`: all else."""
    belief, model = template.belief, template.model
    hit = belief.body.closest(np.where(pressed[:, None], frames.points, 0.0))
    valid = pressed & (np.abs(hit.distance) < unit_checks.MAX_DISTANCE)
    if not template.learned:  # a learned response needs no valid model
        valid &= model.is_valid(
            force=np.where(pressed, frames.force, 1.0),
            curvature=hit.curvature,
            indenter_radius=belief.indenter.radius,
            effective_modulus=template.modulus,
        )
    hit, kept = hit.take(valid), frames.take(valid)
    headings = None if template.headings is None else _headings(kept)
    return replace(
        template,
        points=kept.points,
        normals=hit.normal,
        directions=hit.direction,
        curvature=hit.curvature,
        force=kept.force,
        time=np.zeros(len(kept)) if kept.time is None else kept.time,
        patches=nominal_patches(model, belief, kept.force, hit.curvature),
        headings=headings,
        contact_errors=None if template.contact_errors is None else _errors(kept),
    ), valid


def _errors(frames: ContactFrames) -> Array:
    return np.zeros((len(frames), 3)) if frames.errors is None else frames.errors


def _headings(frames: ContactFrames) -> Array:
    if frames.headings is None:
        raise CalibrationError(
            "an unknown indenter offset needs the body's orientation in every contact",
            value="headings = None",
            remedy="give ContactFrames(headings=...), or leave the offset out",
        )
    return frames.headings
