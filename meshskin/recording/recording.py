"""The recording: what a simulation or a robot writes, and what calibration reads.

A recording consists of Parquet tables. `contacts` has one row per frame in contact: time (s), px py
pz (contact point in the body frame, m), nx ny nz (outward normal there), force (N), and optionally
qw qx qy qz (unit quaternion of the body's rotation, world from body). `readings` is sparse: time
(s), taxel (id), pressure (Pa), for pressures above the threshold. `motion`, from simulations only,
has one row per step.

A robot's own log may be two CSV files with the same columns (csv_log.py).
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
from numpy.typing import ArrayLike

from ..core import arrow
from ..core.arguments import check_array, check_name, repr_short
from ..core.arrays import Array, nearest_rows
from ..core.errors import RecordingError
from ..core.notebook import Card, data_frame
from ..core.provenance import digest
from ..core.value import Value
from . import csv_log
from .recording_files import RecordingWriter, common_part, part_path, read_table

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

CONTACT_SCHEMA = pa.schema(
    [(name, pa.float64()) for name in ("time", "px", "py", "pz", "nx", "ny", "nz", "force")]
)
QUATERNION = ("qw", "qx", "qy", "qz")
"""Optional columns of `contacts`."""
READING_SCHEMA = pa.schema(
    [("time", pa.float64()), ("taxel", pa.int32()), ("pressure", pa.float64())]
)
MAX_TIME_LAG = 0.49
"""Largest distance in time of a reading from its contact, in frames: at half a frame two contacts
are equally near."""
NOMINAL = "nominal"
"""Value of "force" in the metadata of a recording without measured forces: the column `force` then
holds a reference force."""
FROM_TAXELS = "taxels"
"""Value of "contact_points" in the metadata where the robot computed them from its own taxels."""
JOINT_ANGLES = "joint angles"
"""Value of "source" in the metadata where contacts were computed from joint angles: their normals
are those of the body's surface."""
UNCOMPARED = "not compared"
"""Value of "clock" in the metadata where the clock of the skin was not compared with that of the
contacts."""
_PARTS = ("contacts", "readings", "motion")
_COLUMNS = {
    "time": ("contacts", ("time",)),
    "points": ("contacts", ("px", "py", "pz")),
    "normals": ("contacts", ("nx", "ny", "nz")),
    "force": ("contacts", ("force",)),
    "pressure": ("readings", ("pressure",)),
}
"""Table and columns by the name of a property."""


def _column(table: pa.Table, name: str) -> np.ndarray:
    return arrow.values(table.column(name))


@dataclass(frozen=True, eq=False)
class Recording(Value, Card):
    """Contacts and readings of one exploration, with metadata.

    The metadata of a simulation hold at least taxel_ids (all taxels, read or not), disc_radius_m
    and threshold_pa. Raises RecordingError for tables that lack a column or are not in order.
    """

    contacts: pa.Table
    """time, s; px, py, pz, m, nx, ny, nz, body frame; force, N; qw, qx, qy, qz where known."""
    readings: pa.Table
    """time, s; taxel, its id; pressure, Pa: those above the threshold, in time order."""
    metadata: dict[str, Any]
    """Facts of the recording by name; they are saved as JSON."""
    motion: pa.Table | None = None
    """From simulations only: joint angles and forces, one row per step; None: not kept."""

    def __post_init__(self) -> None:
        for name, table, schema in (
            ("contacts", self.contacts, CONTACT_SCHEMA),
            ("readings", self.readings, READING_SCHEMA),
        ):
            missing = set(schema.names) - set(table.column_names)
            if missing:
                raise RecordingError(
                    f"the {name} table lacks {', '.join(sorted(missing))}",
                    remedy=f"it needs the columns {', '.join(schema.names)}",
                )
        if len(self.time) > 1 and not np.all(np.diff(self.time) > 0):
            k = int(np.argmin(np.diff(self.time) > 0)) + 1
            raise RecordingError(
                "contact times must increase",
                value=f"{self.time[k]} s after {self.time[k - 1]} s in row {k} of contacts",
                remedy="sort the rows by time, one row per frame",
            )

    def __repr__(self) -> str:
        taxels = len(self.metadata.get("taxel_ids", ()))
        span = f"{self.time[-1] - self.time[0]:.4g} s" if len(self.time) else "nothing"
        return (
            f"<Recording: {len(self.time)} contacts over {span}, {len(self.readings)} readings of "
            f"{taxels} taxels, {'without' if self.motion is None else 'with'} the arm's motion>"
        )

    def facts(self) -> dict[str, str]:
        """Contacts, forces, readings and what else is recorded, for a notebook."""
        known, count = len(self.metadata.get("taxel_ids", ())), len(self.time)
        facts = {"contacts": f"{count:,}", "readings": f"{len(self.readings):,}"}
        facts["taxels"] = f"{len(np.unique(self.reading_taxel))} read" + f" of {known}" * bool(
            known
        )
        if count:
            low, high = self.force.min(), self.force.max()
            facts["duration"] = f"{self.time[-1] - self.time[0]:.4g} s"
            facts["force"] = f"median {np.median(self.force):.4g} N, {low:.4g} to {high:.4g} N"
            facts["force"] += "" if self.force_measured else ", not measured: a reference force"
        facts["arm's motion"] = "none" if self.motion is None else f"{len(self.motion):,} steps"
        lost = self.metadata.get("unreachable") or {}
        return facts | ({"taxels not covered": str(len(lost))} if lost else {})

    def plot(self, ax: Axes | None = None) -> Figure:
        """Draw the contact points, coloured by the force; ax: matplotlib axes (None: a figure).

        Raises RecordingError without contacts.
        """
        from ..core import drawing

        if not len(self.time):
            raise RecordingError("the recording has no contacts to draw")
        return drawing.solid(
            ax,
            toward=drawing.front(self.normals),
            points=self.points,
            normals=self.normals if np.isfinite(self.normals).all() else None,
            values=self.force,
            label="force (N)",
            title=f"{len(self.time)} contacts",
        )

    def to_pandas(self, part: str = "contacts") -> pd.DataFrame:
        """One of the tables contacts, readings and motion, which are Arrow tables, as a DataFrame.

        Raises UnknownNameError for another name, RecordingError without motion, ConfigError without
        pandas.
        """
        check_name("table of a recording", part, _PARTS)
        table = getattr(self, part)
        if table is None:
            raise RecordingError(f"the recording has no table {part}")
        return data_frame(table)

    @property
    def force_measured(self) -> bool:
        """Whether the forces were measured; else all are a reference force."""
        return bool(self.metadata.get("force") != NOMINAL)

    @property
    def points_from_taxels(self) -> bool:
        """Whether the robot computed the contact points from the taxels that answered."""
        return bool(self.metadata.get("contact_points") == FROM_TAXELS)

    @cached_property
    def time(self) -> Array:
        """Times of the contacts (m,), s."""
        return _column(self.contacts, "time")

    @cached_property
    def points(self) -> Array:
        """Contact points (m, 3) in the body frame, m."""
        return np.stack([_column(self.contacts, c) for c in ("px", "py", "pz")], axis=1)

    @cached_property
    def normals(self) -> Array:
        """Outward body normals (m, 3) at the contact points, body frame."""
        return np.stack([_column(self.contacts, c) for c in ("nx", "ny", "nz")], axis=1)

    @cached_property
    def force(self) -> Array:
        """Normal contact forces (m,), N."""
        return _column(self.contacts, "force")

    @cached_property
    def digest(self) -> str:
        """Digest of contacts and readings, by which a result names the recording it is from."""
        readings = _column(self.readings, "time"), self.reading_taxel, self.pressure
        columns = (self.time, self.points, self.normals, self.force, *readings)
        return digest(*(np.asarray(column, dtype=float) for column in columns))

    @cached_property
    def headings(self) -> Array | None:
        """Rotations (m, 3, 3), world from body, of the contacts; None where not recorded.

        Raises RecordingError for a quaternion whose norm is not 1.
        """
        from scipy.spatial.transform import Rotation

        if not set(QUATERNION) <= set(self.contacts.column_names):
            return None
        quaternion = np.stack([_column(self.contacts, c) for c in QUATERNION], axis=1)
        bad = np.flatnonzero(~(np.abs(np.linalg.norm(quaternion, axis=1) - 1) < 1e-3))
        if len(bad):
            raise RecordingError(
                "qw, qx, qy, qz must be unit quaternions",
                value=f"{quaternion[bad[0]].tolist()} in row {bad[0]} of contacts",
                limit="norm 1 within 1e-3",
                remedy="write the body's rotation, world from body",
            )
        return np.asarray(Rotation.from_quat(quaternion[:, [1, 2, 3, 0]]).as_matrix())

    @cached_property
    def reading_contact(self) -> np.ndarray:
        """Row (k,) of `contacts` that each reading belongs to: the nearest in time.

        Raises RecordingError for a reading further than half a frame from every contact.
        """
        times, row = _column(self.readings, "time"), self._nearest_contact
        far = ~(np.abs(self.time_lag) <= MAX_TIME_LAG * self.frame)  # or not a number
        if np.any(far):
            raise RecordingError(
                "a reading has no contact at its time",
                value=f"{times[np.argmax(far)]} s",
                limit=f"within {MAX_TIME_LAG * self.frame:.3g} s of a contact",
                remedy="write one contact row for every frame of readings",
            )
        return row

    @cached_property
    def _nearest_contact(self) -> np.ndarray:
        """Row (k,) of the contact nearest in time to each reading."""
        times = _column(self.readings, "time")
        if len(self.time) < 2:
            return np.zeros(len(times), dtype=np.intp)
        return nearest_rows(self.time, times)

    @property
    def frame(self) -> float:
        """Median time from one contact to the next, s; 0 for fewer than two contacts."""
        return float(np.median(np.diff(self.time))) if len(self.time) > 1 else 0.0

    @cached_property
    def time_lag(self) -> Array:
        """Time (k,), s, of each reading after that of its contact; NaN without contacts."""
        if not len(self.time):
            return np.full(len(self.readings), np.nan)
        return _column(self.readings, "time") - self.time[self._nearest_contact]

    @cached_property
    def reading_taxel(self) -> np.ndarray:
        """Taxel id of each reading (k,)."""
        return _column(self.readings, "taxel")

    @cached_property
    def pressure(self) -> Array:
        """Pressure of each reading (k,), Pa."""
        return _column(self.readings, "pressure")

    def with_columns(self, **values: ArrayLike) -> Recording:
        """The recording with other `time` (m,), `points` (m, 3), `normals` (m, 3), `force` (m,) or
        `pressure` (k,), in the units of these properties.

        Raises UnknownNameError for another name, RecordingError for arrays of another shape.
        """
        tables = {"contacts": self.contacts, "readings": self.readings}
        for name, given in values.items():
            check_name("column of a recording", name, tuple(_COLUMNS))
            part, columns = _COLUMNS[name]
            array = check_array(name, given, error=RecordingError)
            if array.shape != (shape := np.shape(getattr(self, name))):
                raise RecordingError(f"wrong shape of {name}", value=array.shape, limit=shape)
            for column, numbers in zip(columns, array.reshape(-1, len(columns)).T, strict=True):
                row = tables[part].column_names.index(column)
                tables[part] = tables[part].set_column(row, column, arrow.column(numbers))
        return replace(self, **tables)

    def save(self, path: str | Path) -> None:
        """Write path.contacts.parquet, path.readings.parquet and path.motion.parquet.

        Raises OutputError if they cannot be written, RecordingError for metadata that JSON cannot
        hold; no file is left behind then.
        """
        with RecordingWriter(path, self.metadata) as writer:
            writer.write(contacts=self.contacts, readings=self.readings, motion=self.motion)

    @classmethod
    def load(cls, path: str | Path) -> Recording:
        """Read the recording at `path`, memory-mapped.

        `path` is the common part of its file names, one of these files, or the folder of a run,
        which holds them as `recording`. CSV logs are read, too: from the folder that holds
        contacts.csv and readings.csv, or by the common part of PATH.contacts.csv and
        PATH.readings.csv; the metadata {"readings": "raw"} says that the readings have a unit of
        their own. Raises RecordingError if a table is missing, damaged, or belongs to another
        recording.
        """
        if not isinstance(path, str | os.PathLike):
            raise RecordingError("a recording is loaded by its path", value=repr_short(path))
        path = common_part(Path(path))
        if not part_path(path, "contacts").exists() and (files := csv_log.find(path)):
            contacts, readings = (csv_log.read(*each) for each in zip(files, _PARTS, strict=False))
            for name in ("nx", "ny", "nz"):
                if name not in contacts.column_names:
                    contacts = contacts.append_column(
                        name, pa.array(np.full(len(contacts), np.nan))
                    )
            unit = {k.decode(): v.decode() for k, v in (readings.schema.metadata or {}).items()}
            return cls(contacts, readings, {"source": [file.name for file in files], **unit})
        tables: dict[str, pa.Table] = {}
        headers: dict[str, dict[str, Any]] = {}
        for part in _PARTS:
            file = part_path(path, part)
            if file.exists():
                tables[part], headers[part] = read_table(file)
            elif part != "motion":
                if path.is_file():
                    raise RecordingError(
                        f"{path} is one file, which needs a map that says what its columns are",
                        remedy=f"meshskin init {path} writes one; then --map, or ms.read_log",
                    )
                raise RecordingError(
                    f"no recording at {path}: {file.name} is missing",
                    remedy="check the path; a log is contacts.csv and readings.csv in a folder, "
                    "or a file and a map of it: meshskin init LOG, then --map",
                )
        if len({header.get("recording_id") for header in headers.values()}) > 1:
            raise RecordingError(
                f"the tables at {path} come from different recordings",
                remedy="delete them and record again",
            )
        header = headers["contacts"]
        header.pop("recording_id", None)
        return cls(tables["contacts"], tables["readings"], header, tables.get("motion"))
