"""All contacts and readings so far, in arrays that grow, and the measurements of a few taxels."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from scipy.spatial import cKDTree

from ...contact import Patches
from ...core.arrays import Array
from ...recording.recording import CONTACT_SCHEMA, QUATERNION, READING_SCHEMA
from ..data.measurements import Measurements
from ..data.patch_shape import ALIKE, alike_contacts
from ..data.resolve_belief import nominal_patches

TREE_STEP = 1000
"""Contacts after which the search tree is built again: 1 ms at 10,000, and the rest is searched
one by one, in 0.1 ms."""
RESPONSE = 5.0
"""Standard deviations of the noise from which a reading is a response: where the threshold is below
them, untouched taxels have readings of noise, which tell no place."""
TYPICAL = ("nominal_peak", "typical_curvature")
"""What a learned response refers to: medians over the contacts that it was learned from."""


class GrowingRows:
    """Rows of an array that are appended to in amortized constant time."""

    def __init__(self, shape: tuple[int, ...], kind: type = float) -> None:
        """shape: of a row."""
        self._data: np.ndarray = np.empty((256, *shape), dtype=kind)
        self.count = 0

    def append(self, values: Any) -> None:
        """Append rows."""
        end = self.count + len(values)
        if end > len(self._data):
            grown = np.empty(
                (max(end, 2 * len(self._data)), *self._data.shape[1:]), self._data.dtype
            )
            grown[: self.count] = self.values
            self._data = grown
        self._data[self.count : end] = values
        self.count = end

    @property
    def values(self) -> Any:
        """All rows, a view."""
        return self._data[: self.count]


class Part(NamedTuple):
    """Measurements of some taxels in some contacts."""

    data: Measurements
    rows: np.ndarray
    """Rows (k,) of the readings in the store."""


class ContactStore:
    """m contacts and their readings; a reading of NaN is lost, one that is not there is silence."""

    def __init__(self, first: Measurements) -> None:
        """first: measurements without contacts, which have all else."""
        self.template = first
        shapes: dict[str, tuple[int, ...]] = {
            "points": (3,), "normals": (3,), "directions": (3,), "curvature": (2,), "force": (),
            "time": (), "unevenness": (),
        }  # fmt: skip
        if first.headings is not None:
            shapes["headings"] = (3, 3)
        if first.contact_errors is not None:
            shapes["contact_errors"] = (3,)
        self.columns = {name: GrowingRows(shape) for name, shape in shapes.items()}
        self.columns["recorded"] = GrowingRows((), int)
        self.patches = {name: GrowingRows(()) for name in Patches._fields}
        self.contact, self.taxel = GrowingRows((), int), GrowingRows((), int)
        self.pressure, self.weight = GrowingRows(()), GrowingRows(())
        self.misfitting = GrowingRows((), bool)
        """Contacts (m,) most of whose readings contradict all others: they have no readings."""
        self._typical = {name: getattr(first, name) for name in TYPICAL} if first.learned else {}
        self.rows: list[list[int]] = [[] for _ in first.ids]
        """Rows of the readings of each taxel."""
        self.counts = np.zeros(len(first.ids), dtype=int)
        """Responses (n,) of each taxel."""
        self.lowest = np.inf
        """The smallest reading, Pa."""
        self._mass, self._moment = np.zeros(len(first.ids)), np.zeros((len(first.ids), 3))
        self._tree: Any = None
        self._in_tree = 0

    @property
    def count(self) -> int:
        """Number m of contacts."""
        return self.columns["force"].count

    @property
    def means(self) -> Array:
        """Mean contact points (n, 3), m, weighted by pressure squared; NaN without responses."""
        with np.errstate(invalid="ignore"):
            return np.asarray(self._moment / self._mass[:, None])

    @property
    def noise_is_nominal(self) -> bool:
        """Whether the noise is neither known nor estimated yet (settling.py)."""
        return self.template.belief.noise_sigma is None and not self.template.noise_pairs

    @property
    def threshold(self) -> float:
        """Pressure, Pa, up to which taxels are silent: as believed, or the smallest reading."""
        lowest = self.lowest if np.isfinite(self.lowest) else 0.0
        return max(self.template.belief.threshold, lowest)

    def append(
        self, block: Measurements, readings: tuple[np.ndarray, np.ndarray, Array]
    ) -> tuple[int, int]:
        """Append the contacts of `block`, and contact, taxel and pressure (k,) of readings, NaN
        where they are lost. Returns the row of the first contact and of the first reading."""
        first, first_reading = self.count, self.pressure.count
        for name, rows in self.columns.items():
            rows.append(getattr(block, name))
        for name, rows in self.patches.items():
            rows.append(np.broadcast_to(getattr(block.patches, name), len(block.force)))
        self.misfitting.append(np.zeros(len(block.force), dtype=bool))
        contact, taxel, pressure = readings
        for row, k in enumerate(taxel.tolist(), first_reading):
            self.rows[k].append(row)
        self.contact.append(contact + first)
        self.taxel.append(taxel)
        self.pressure.append(pressure)
        self.weight.append(np.ones(len(pressure)))
        high = self._responses(pressure)
        weight = np.where(high, pressure, 0.0) ** 2
        np.add.at(self._mass, taxel, weight)
        np.add.at(self._moment, taxel, weight[:, None] * block.points[contact])
        np.add.at(self.counts, taxel[high], 1)
        self.lowest = float(np.fmin(self.lowest, np.nanmin(pressure, initial=np.inf)))
        return first, first_reading

    def _responses(self, pressure: Array) -> np.ndarray:
        """Whether readings (k,), Pa, are responses (bool); NaN is none."""
        return np.asarray(pressure > RESPONSE * self.template.sigma)

    def refer(self, template: Measurements) -> None:
        """Take measurements without contacts that have all else, as another contact model."""
        if template.model != self.template.model:
            force, curvature = (self.columns[name].values for name in ("force", "curvature"))
            patches = nominal_patches(template.model, template.belief, force, curvature)
            for name, rows in self.patches.items():
                rows.values[:] = getattr(patches, name)
        self.template = template

    def tables(self, ids: np.ndarray, period: float) -> tuple[pa.Table, pa.Table]:
        """Contacts and readings as a recording has them, of taxels with `ids` (n,). Times that do
        not rise are replaced by those of a frame each `period`, s."""
        order = np.argsort(self.columns["recorded"].values, kind="stable")
        columns = {name: rows.values[order] for name, rows in self.columns.items()}
        time = columns["time"]
        if not (np.diff(time) > 0).all():  # of several recordings
            time = period * np.arange(self.count)
        table = pa.table(
            [time, *columns["points"].T, *columns["normals"].T, columns["force"]],
            schema=CONTACT_SCHEMA,
        )
        if "headings" in columns:
            from scipy.spatial.transform import Rotation

            quaternions = Rotation.from_matrix(columns["headings"]).as_quat()[:, [3, 0, 1, 2]]
            for name, values in zip(QUATERNION, quaternions.T, strict=True):
                table = table.append_column(name, pa.array(values))
        contact = np.argsort(order)[self.contact.values]
        rows = np.argsort(contact, kind="stable")
        kind = np.promote_types(np.int32, np.min_scalar_type(ids.max()))  # of ids beyond 2^31, too
        schema = READING_SCHEMA.set(1, pa.field("taxel", pa.from_numpy_dtype(kind)))
        taxel = ids[self.taxel.values[rows]].astype(kind)
        readings = [time[contact[rows]], taxel, self.pressure.values[rows]]
        return table, pa.table(readings, schema=schema)

    def latest(self, count: int) -> Measurements:
        """Responses of all taxels in the latest contacts, at most `count`."""
        contacts = np.argsort(self.columns["recorded"].values, kind="stable")[-count:]
        row = np.full(self.count, -1)
        row[contacts] = np.arange(len(contacts))
        rows = np.flatnonzero(row[self.contact.values] >= 0)
        rows = rows[self._responses(self.pressure.values[rows])]
        return replace(
            self.template,
            points=self.columns["points"].values[contacts],
            normals=self.columns["normals"].values[contacts],
            time=self.columns["time"].values[contacts],
            contact=row[self.contact.values[rows]],
            taxel=self.taxel.values[rows],
            pressure=self.pressure.values[rows],
            threshold=self.threshold,
        )

    def near(self, points: Array, radius: float) -> np.ndarray:
        """Contacts, rising, within `radius`, m, of any of the points (p, 3)."""
        where = self.columns["points"].values
        if len(where) >= self._in_tree + TREE_STEP:
            self._tree, self._in_tree = cKDTree(where.copy()), len(where)
        found = np.flatnonzero(
            cKDTree(points).query(where[self._in_tree :], distance_upper_bound=radius)[0] < np.inf
        )
        found = found + self._in_tree
        if self._tree is not None:
            inside = self._tree.query_ball_point(points, radius)
            old = np.unique(np.concatenate([np.asarray(part, dtype=int) for part in inside]))
            found = np.concatenate([old, found])
        return found

    def part(self, taxels: np.ndarray, contacts: np.ndarray, since: int = 0) -> Part:
        """Measurements of the taxels (t,), which may repeat, in the `contacts`, rising, with their
        readings from row `since` on, and the contacts of these. Their ids are 0 to t - 1."""
        all_rows = [self.rows[k] for k in taxels.tolist()]
        own = [np.array(rows[bisect_left(rows, since) :], dtype=int) for rows in all_rows]
        rows = np.concatenate([np.empty(0, dtype=int), *own])
        taxel = np.repeat(np.arange(len(taxels)), [len(part) for part in own])
        return self._part(taxels, contacts, rows, taxel)

    def part_of(self, taxels: np.ndarray, contacts: np.ndarray) -> Part:
        """As `part`, of the taxels (t,), rising, without readings in other contacts."""
        inside = np.isin(self.contact.values, contacts) & np.isin(self.taxel.values, taxels)
        rows = np.flatnonzero(inside)
        return self._part(taxels, contacts, rows, np.searchsorted(taxels, self.taxel.values[rows]))

    def _part(
        self, taxels: np.ndarray, contacts: np.ndarray, rows: np.ndarray, taxel: np.ndarray
    ) -> Part:
        """The readings `rows` (k,) of the taxels of numbers `taxel` (k,), and the `contacts`."""
        kept = ~self.misfitting.values[self.contact.values[rows]]
        rows, taxel = rows[kept], taxel[kept]
        contact, pressure = self.contact.values[rows], self.pressure.values[rows]
        contacts = np.union1d(contacts, contact)
        contact, sound = np.searchsorted(contacts, contact), np.isfinite(pressure)
        saturation = self.template.saturation
        data = replace(
            self.template,
            **{name: rows.values[contacts] for name, rows in self.columns.items()},
            patches=Patches(**{name: rows.values[contacts] for name, rows in self.patches.items()}),
            contact=contact[sound],
            taxel=taxel[sound],
            pressure=pressure[sound],
            threshold=self.threshold,
            ends=np.full(len(taxels), saturation),
            constant=np.zeros(len(taxels), dtype=bool),
            corrupt=np.column_stack([contact, taxel])[~sound],
            misfitting=np.flatnonzero(self.misfitting.values[contacts]),
        )
        groups = self.template.groups[taxels]
        data.__dict__.update(self._typical, ids=np.arange(len(taxels)), groups=groups)
        data.__dict__.update(rest=self._rest(taxels), alike=self._alike(data, contacts))
        return Part(data, rows[sound])

    def _alike(self, data: Measurements, contacts: np.ndarray) -> Array:
        """`Measurements.alike` among all contacts so far, of the `contacts` (m) of `data`."""
        over, alike = np.flatnonzero(data.unevenness), np.ones(len(contacts))
        if data.learned or not len(over):
            return alike
        near = self.near(data.points[over], ALIKE * float(data.radii[over].max()))
        points, uneven = (self.columns[name].values[near] for name in ("points", "unevenness"))
        first, second = (self.patches[name].values[near] for name in ("first", "second"))
        found = alike_contacts(points, uneven > 0, np.sqrt(first * second))
        alike[over] = found[np.searchsorted(near, contacts[over])]
        return alike

    def _rest(self, taxels: np.ndarray) -> Array:
        """What the taxels (t,) read in most contacts, as `Measurements.rest`."""
        level, middle = np.full(len(taxels), self.threshold), self.count // 2
        if "offset" in self.template.parameters.nuisance_names:
            for k in np.flatnonzero(self.counts[taxels] > middle):
                values = self.pressure.values[self.rows[taxels[k]]]
                level[k] = -np.sort(-values[np.isfinite(values)])[middle]
        return level
