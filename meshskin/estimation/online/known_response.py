"""The online calibration of a recording whose response a calibration of all of it has learned.

Online, forces and a response of another kind cannot be learned from few contacts: they are taken as
known, with the errors of the contacts. Positions, gains and offsets of the taxels are estimated
anew. What is taken as known is uncertain, too: standard deviations are multiplied by one factor,
such that in the median they end as those of the calibration.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyarrow as pa

from ...contact import LEARNED
from ...core.arrays import Array
from ...core.errors import CalibrationError
from ...recording.recording import CONTACT_SCHEMA, READING_SCHEMA, Recording
from ...scene.belief import Belief
from ..calibration import Calibration
from ..cross_validation import recorded_belief
from ..data.gather import gather
from ..data.global_parameters import DEPARTURES
from ..data.measurements import Measurements
from ..localization import CalibratedSkin
from .linearization import local_estimator
from .online_calibration import OnlineCalibration
from .running_estimate import RunningEstimate

NUISANCE = ("gain", "offset")
"""Unknowns of a taxel that are estimated anew."""


@dataclass(frozen=True)
class KnownResponse:
    """Contacts and readings of a recording, and the response that was learned from them."""

    recording: Recording
    """Contacts in their places, and readings above the threshold in nominal Pa."""
    belief: Belief
    """What is believed of them."""
    errors: Array
    """Estimated errors (m, 3) of the contacts, as `Calibration.contact_errors`."""
    template: Measurements
    """Measurements with the learned response."""
    values: Array
    """The global parameters (ks,) of the response."""
    widening: float
    """Factor of the standard deviations."""

    @classmethod
    def of(cls, found: Calibration, recording: Recording) -> KnownResponse:
        """The response of the calibration `found` of a recording.

        Its readings are without what hysteresis, creep, crosstalk and drifts add to them by that
        calibration. Raises CalibrationError for a calibration without learned response.
        """
        response, errors = found.response, found.contact_errors
        if response is None or errors is None:
            raise CalibrationError(
                "the calibration has no learned response of this recording",
                remedy='calibrate the recording with readings="raw" or contact="learned"',
            )
        belief = replace(recorded_belief(found), contact=LEARNED)
        skin = _without_departures(CalibratedSkin.of(found, gather(recording, belief)), found)
        data = skin.data
        template = _template(skin, 0 if found.fit is None else found.fit.pairs)
        left_out = np.flatnonzero(np.isnan(errors).any(axis=1))
        rows = np.setdiff1d(np.arange(len(data.points)), np.union1d(data.unread, left_out))
        return cls(
            recording=_recording(data, rows, recording.metadata),
            belief=replace(data.belief, readings="pressure", contact_motion=None),
            errors=errors[rows],
            template=template,
            values=skin.s,
            widening=_widening(
                found, skin, replace(template, contact_errors=np.nan_to_num(errors))
            ),
        )

    def online(
        self, target_sigma: float = 1e-4, unreachable: Collection[int] = ()
    ) -> OnlineCalibration:
        """An online calibration for the contacts of `recording`, which are to be given with their
        `errors`; arguments as of `OnlineCalibration`."""
        template = self.template
        belief = replace(self.belief, threshold=template.threshold, noise_sigma=template.noise)
        online = OnlineCalibration(belief, target_sigma=target_sigma, unreachable=unreachable)
        online.estimate = RunningEstimate(template, self.values, self.widening)
        return online


def _without_departures(skin: CalibratedSkin, found: Calibration) -> CalibratedSkin:
    """The skin with readings as they were without departures from the response; those that the
    calibration did not use are left out, and saturated ones, which do not say by how much, lost."""
    data, n = skin.data, len(skin.data.ids)
    if found.additions is None:
        return skin
    parameters, rows = data.parameters.without(DEPARTURES)
    key = (found.additions[:, 0] * n + found.additions[:, 1]).astype(int)
    added, mine = found.additions[:, 2], data.contact * n + data.taxel
    order = np.argsort(key)
    at = order[np.searchsorted(key, mine, sorter=order) % len(key)]
    used, full = key[at] == mine, data.pressure >= data.ends[data.taxel]
    silent, lost = added[~np.isin(key, mine)], np.column_stack([data.contact, data.taxel])[full]
    data = replace(
        data,
        parameters=parameters,
        pressure=np.maximum(data.pressure - added[at], 0.0),
        threshold=data.threshold - float(silent.min(initial=0.0)),
        corrupt=np.concatenate([data.corrupt, lost]),
    )
    return replace(skin, data=data.select(used & ~full), s=skin.s[rows], past=None)


def _template(skin: CalibratedSkin, pairs: int) -> Measurements:
    """The measurements of a skin with the spread of its taxels' own unknowns as their priors, and
    the root mean square of the noise of its readings."""
    data, parameters = skin.data, skin.data.parameters
    kept = [name for name in NUISANCE if name in parameters.nuisance_names]
    spread = np.sqrt(np.mean(skin.nuisance[skin.live] ** 2, axis=0))
    units = {"gain": 1.0, "offset": data.sigma}
    columns = {name: spread[parameters.nuisance_names.index(name)] for name in kept}
    least = {"gain": 1e-3, "offset": 1e-3}
    sigma = tuple(max(float(columns[name]), least[name]) * units[name] for name in kept)
    noise = skin.deviations.noise_of(data.pressure / data.sigma) * data.sigma
    return replace(
        data,
        parameters=replace(parameters, nuisance_names=tuple(kept), nuisance_sigma=sigma),
        noise=float(np.sqrt(np.mean(noise**2))),
        noise_pairs=pairs,
        unread=np.empty(0, dtype=int),
        headings=None,  # contacts are in their places
        contact_errors=np.zeros((len(data.points), 3)),
    )


def _widening(found: Calibration, skin: CalibratedSkin, data: Measurements) -> float:
    """Median ratio of the standard deviations of a calibration to those with the response and the
    contacts' errors, which `data` has, as known."""
    live, weight = skin.live, np.ones(len(data.pressure))
    rotations, nuisance = found.poses[live, :3, :3], skin.nuisance[live, : len(NUISANCE)]
    estimator = local_estimator(
        data, weight, skin.points[live], rotations, nuisance, skin.s, live
    )  # fmt: skip
    hessian = estimator.problem.blocks(estimator.state).hessian
    own = np.linalg.inv(hessian)[:, :2, :2]
    ratio = found.position_sigma[live] / np.sqrt(np.trace(own, axis1=1, axis2=2))
    return max(1.0, float(np.median(ratio)))


def _recording(data: Measurements, rows: np.ndarray, metadata: Mapping[str, Any]) -> Recording:
    """The contacts `rows` of the measurements, and their readings, NaN where they are lost;
    metadata: of the recording."""
    columns = [data.time[rows], *data.points[rows].T, *data.normals[rows].T, data.force[rows]]
    lost = data.corrupt
    contact = np.concatenate([data.contact, lost[:, 0]])
    taxel = np.concatenate([data.taxel, lost[:, 1]])
    pressure = np.concatenate([data.pressure, np.full(len(lost), np.nan)])
    read = np.flatnonzero(np.isin(contact, rows))
    read = read[np.argsort(contact[read], kind="stable")]
    ids = data.ids[taxel[read]]
    schema = READING_SCHEMA.set(1, pa.field("taxel", pa.from_numpy_dtype(ids.dtype)))
    readings = [data.time[contact[read]], ids, pressure[read]]
    kept = {name: metadata[name] for name in ("force", "unreachable") if name in metadata}
    return Recording(
        pa.table(columns, schema=CONTACT_SCHEMA),
        pa.table(readings, schema=schema),
        {"taxel_ids": data.ids.tolist(), **kept},
    )
