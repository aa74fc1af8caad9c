"""What comes in: frames of contact without a table, beliefs that can be estimated online, and the
measurements of new contacts."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ... import contact
from ...core.arguments import check_array, check_type, check_vectors
from ...core.arrays import Array
from ...core.errors import CalibrationError, RecordingError
from ...core.value import Value
from ...recording.recording import Recording
from ...scene.belief import Belief
from ..calibration import Calibration
from ..data import unit_checks
from ..data.gather import taxel_rows
from ..data.global_parameters import declared_parameters
from ..data.measurements import NOMINAL_NOISE, Measurements
from ..data.patch_shape import over_edges
from ..data.resolve_belief import contact_model, in_range, nominal_patches, resolve_belief


@dataclass(frozen=True, eq=False)
class ContactFrames(Value):
    """B frames of contact. Raises RecordingError for arrays of other shapes.

    Frames without contact have the force 0, or are left out.
    """

    points: Array
    """Contact points (B, 3), body frame, m; (3,) for one frame."""
    force: Array
    """Normal forces (B,), N."""
    headings: Array | None = None
    """Rotations of the body (B, 3, 3), world from body; an unknown indenter offset needs them."""
    time: Array | None = None
    """Times (B,), s, rising; None: 50 frames a second."""
    errors: Array | None = None
    """Known errors (B, 3) of points and forces, as `Calibration.contact_errors`; None: none."""

    def __post_init__(self) -> None:
        points = np.atleast_2d(check_array("contact points", self.points, error=RecordingError))
        points = check_vectors("contact points", points, error=RecordingError)
        force = np.atleast_1d(check_array("contact forces", self.force, error=RecordingError))
        if force.shape not in ((1,), (len(points),)):
            raise RecordingError(
                "forces of contact frames", value=f"shape {force.shape}", limit=f"({len(points)},)"
            )
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "force", np.broadcast_to(force, len(points)))
        for name, shape in (
            ("headings", (len(points), 3, 3)),
            ("time", (len(points),)),
            ("errors", (len(points), 3)),
        ):
            if (value := getattr(self, name)) is not None:
                value = check_array(f"{name} of contact frames", value, error=RecordingError)
                if value.ndim < len(shape):  # of one frame
                    value = value[None]
                if value.shape != shape:
                    raise RecordingError(
                        f"{name} of contact frames", value=f"shape {value.shape}", limit=str(shape)
                    )
                object.__setattr__(self, name, value)

    def __len__(self) -> int:
        return len(self.points)

    def take(self, rows: slice | np.ndarray) -> ContactFrames:
        """The frames `rows`: a slice, a mask or indices."""
        others = (
            None if values is None else values[rows]
            for values in (self.headings, self.time, self.errors)
        )
        return ContactFrames(self.points[rows], self.force[rows], *others)


class RecordedFrames:
    """The contacts of a recording, with dense readings a few at a time."""

    def __init__(self, recording: Recording, ids: np.ndarray, errors: Array | None = None) -> None:
        """ids (n,): of the taxels; errors (m, 3): of the contacts, where known. Raises
        CalibrationError if a taxel that was read is not among them, RecordingError if one is read
        twice in a contact."""
        check_type(Recording, recording, "recording of an update")
        taxel = taxel_rows(recording.reading_taxel, ids)
        unit_checks.check_unique(recording, taxel, len(ids))
        order = np.argsort(recording.reading_contact, kind="stable")
        self._contact, self._pressure = recording.reading_contact[order], recording.pressure[order]
        self._taxel, self._count = taxel[order], len(ids)
        self._frames = ContactFrames(
            recording.points, recording.force, recording.headings, recording.time, errors
        )

    def part(self, begin: int, end: int) -> tuple[ContactFrames, Array]:
        """Contacts `begin` to `end`, and their readings (end - begin, n), Pa, 0 where silent."""
        contacts = self._frames.take(slice(begin, end))
        rows = slice(*np.searchsorted(self._contact, (begin, end)))
        readings = np.zeros((len(contacts), self._count))
        readings[self._contact[rows] - begin, self._taxel[rows]] = self._pressure[rows]
        return contacts, readings


def sparse(readings: Array, threshold: float) -> tuple[np.ndarray, np.ndarray, Array]:
    """Frame, taxel and pressure (k,) of the readings (B, n) that say more than that a taxel is
    silent: those above `threshold`, Pa, and, as NaN, those that are not finite or negative.
    """
    with np.errstate(invalid="ignore"):
        lost, read = ~((readings >= 0) & np.isfinite(readings)), readings > threshold
    frame, taxel = np.nonzero(lost | read)
    return frame, taxel, np.where(lost, np.nan, readings)[frame, taxel]


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
    noise that `frames` show where the belief leaves them open.

    Raises CalibrationError for frames far from the body, ContactError where no model holds.
    """
    hit = belief.body.closest(frames.points)
    unit_checks.check_points(belief.body, frames.points, hit.distance)
    belief = resolve_belief(belief, frames)  # type: ignore[arg-type]
    model = contact_model(belief)
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
    template: Measurements, frames: ContactFrames, pressed: np.ndarray, first: int
) -> tuple[Measurements, np.ndarray, np.ndarray]:
    """The contacts of the frames `pressed` (B,) bool that are on the body and in the range of the
    contact model, which of the frames these are, and which are on the body but outside that range;
    `template`: all else; first: number of the first frame."""
    belief, model = template.belief, template.model
    hit = belief.body.closest(np.where(pressed[:, None], frames.points, 0.0))
    on_body = pressed & (np.abs(hit.distance) < unit_checks.MAX_DISTANCE)
    valid = on_body
    if not template.learned:  # a learned response needs no valid model
        force = np.where(pressed, frames.force, 1.0)
        valid = on_body & in_range(model, belief, force, hit.curvature)
    hit, kept = hit.take(valid), frames.take(valid)
    headings = None if template.headings is None else _headings(kept)
    errors = np.zeros((len(kept), 3)) if kept.errors is None else kept.errors
    found = replace(
        template,
        points=kept.points,
        normals=hit.normal,
        directions=hit.direction,
        curvature=hit.curvature,
        force=kept.force,
        unevenness=over_edges(belief, hit, kept.force, template.edge_error),
        time=np.zeros(len(kept)) if kept.time is None else kept.time,
        recorded=first + np.flatnonzero(valid),
        patches=nominal_patches(model, belief, kept.force, hit.curvature),
        headings=headings,
        contact_errors=None if template.contact_errors is None else errors,
    )
    return found, valid, on_body & ~valid


def _headings(frames: ContactFrames) -> Array:
    if frames.headings is None:
        raise CalibrationError(
            "an unknown indenter offset needs the body's orientation in every contact",
            value="headings = None",
            remedy="give ContactFrames(headings=...), or leave the offset out",
        )
    return frames.headings
