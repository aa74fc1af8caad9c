"""The touches of a recording in the unit of an earlier map, under the response that it has.

Raw readings are brought to the unit and the polarity of the map's calibration, whose response
predicts them: a few contacts alone would determine neither.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...core import arrow
from ...core.errors import CalibrationError
from ...recording.recording import Recording
from ...scene.belief import RAW, Belief
from ..calibration import Calibration
from ..data.gather import gather, gather_or_learn
from ..data.measurements import Measurements
from ..data.raw_readings import quantum
from ..learned.result import FALLING
from ..localization import CalibratedSkin
from .skin_map import SkinMap
from .touches import Touches

MIN_READINGS = 8
"""Least number of readings: four errors are estimated from them."""
PER_CONTACT = (
    "points", "normals", "directions", "curvature", "force", "headings", "contact_errors",
    "unevenness", "time", "recorded",
)  # fmt: skip
"""Fields of `Measurements` with a row a contact, empty or None where it has none."""
CONTACTS_PER_TAXEL = 5
"""Contacts per taxel that are used at most, evenly chosen: neighbouring frames of a sweep share
their errors and say little more."""


def read(recording: Recording, belief: Belief, known: SkinMap) -> Touches:
    """The readings under the map's E* or learned response, thinned. Raises CalibrationError."""
    response = known.calibration.response
    if belief.readings == RAW:
        if response is None:
            raise CalibrationError(
                "raw readings need an earlier map whose calibration learned the response",
                value="a map without one",
                remedy="calibrate again, and compare the maps with `meshskin diff`",
            )
        if FALLING in known.calibration.factors:
            recording = _turned(recording)
    mapped = replace(_as_mapped(belief, known.calibration), taxel_ids=known.ids)
    data = gather(recording, mapped) if response is None else gather_or_learn(recording, mapped)[0]
    if len(data.pressure) < MIN_READINGS:
        raise CalibrationError(
            "too few readings to tell a change from noise", value=len(data.pressure),
            limit=f"at least {MIN_READINGS}", remedy="touch the skin at more places",
        )  # fmt: skip
    step = -(-len(data.points) // (CONTACTS_PER_TAXEL * len(known.ids)))
    if step > 1:
        data = _of_contacts(data, np.arange(len(data.points)) % step == 0)
    return touches_of(data, known)


def touches_of(data: Measurements, known: SkinMap) -> Touches:
    """The measurements as the map's contact model, or its learned response, predicts them."""
    response = known.calibration.response
    if response is None:
        return Touches(data, known)
    belief = replace(data.belief, contact=response.contact)
    skin = CalibratedSkin.of(replace(known.calibration, belief=belief), data)
    noise = (data.belief.noise_sigma or 0.0) * data.unit or response.noise
    return Touches(replace(skin.data, noise=noise / response.unit), known, skin)


def _as_mapped(belief: Belief, previous: Calibration) -> Belief:
    """The belief with the E* that the map's readings were read under."""
    modulus = previous.modulus
    if previous.response is not None:
        if not previous.response.references:
            raise CalibrationError(
                "the earlier calibration does not state what its learned response refers to",
                remedy="calibrate its recording again: it was saved by an earlier version",
            )
        modulus = previous.response.references[3]
    if modulus is None:
        return belief
    ratio = modulus / belief.material.effective_modulus
    material = replace(belief.material, young=belief.material.young * ratio)
    return replace(belief, material=material)


def _turned(recording: Recording) -> Recording:
    """The recording with readings that rise with pressure, as those of a map's that fell."""
    sound = recording.pressure[np.isfinite(recording.pressure)]
    turned = sound.max(initial=0.0) - recording.pressure
    at = recording.readings.column_names.index("pressure")
    turned = arrow.column(turned + quantum(sound))
    return replace(recording, readings=recording.readings.set_column(at, "pressure", turned))


def _of_contacts(data: Measurements, kept: np.ndarray) -> Measurements:
    """The contacts `kept` (m,) bool, with their readings and all else that they have."""
    row, motion = np.cumsum(kept) - 1, data.parameters.motion
    part, corrupt = data.select(kept[data.contact]), data.corrupt[kept[data.corrupt[:, 0]]]
    columns = {name: getattr(data, name) for name in PER_CONTACT}
    return replace(
        part,
        **{name: x[kept] for name, x in columns.items() if x is not None and len(x)},
        patches=data.patches.take(np.flatnonzero(kept)),
        contact=row[part.contact],
        corrupt=np.column_stack([row[corrupt[:, 0]], corrupt[:, 1]]),
        unread=row[data.unread[kept[data.unread]]],
        ended=np.column_stack([data.ended[:, 0], row[data.ended[:, 1]]]),
        parameters=replace(data.parameters, motion=motion and motion.take(kept)),
    )
