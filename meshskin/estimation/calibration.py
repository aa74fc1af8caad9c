"""The calibration: poses of all taxels with covariances, and what the data did not determine."""

from __future__ import annotations

import inspect
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ..core.arguments import check_name, check_type
from ..core.arrays import Array
from ..core.atomic_io import atomic, write_text
from ..core.errors import CalibrationError, ConfigError
from .data.global_parameters import LOGARITHMS
from .result import LearnedResponse
from .uncertainty.goodness_of_fit import GoodnessOfFit
from .uncertainty.verdict import Verdict

if TYPE_CHECKING:
    from ..core.progress import Progress
    from ..recording.recording import Recording
    from ..scene.belief import Belief
    from .cross_validation import CrossValidation
    from .next_contact import NextContacts

UNITS = {"force_offset": "N", "joint_offset": "rad", "clock_offset": "s"} | dict.fromkeys(
    ("exponents", "compression", "force_scatter", "hysteresis", "crosstalk"), ""
)
"""Units of global parameters that are neither lengths nor angles nor logarithms."""
_KEY = b"meshskin-calibration"
_COLUMNS = {
    "ids": "ids",
    "poses": "poses",
    "covariances": "covariances",
    "observed": "observed",
    "touched": "touched",
    "readings": "readings",
    "chi2": "chi2",
    "reasons": "why",
}
"""Columns of a file by field."""
_NUISANCE = "taxel_"
"""Prefix of the columns of nuisance parameters."""
_HEADER = (
    "method",
    "anchor",
    "factors",
    "modulus",
    "modulus_sigma",
    "unknowns",
    "undetermined",
    "seconds",
    "provenance",
)


@dataclass(frozen=True)
class Calibration:
    """Poses of n taxels in the body frame, with their covariances. SI units.

    A taxel that the data did not determine has a pose of NaN, an infinite covariance and an entry
    in `reasons`.
    """

    ids: np.ndarray
    """Taxel ids (n,)."""
    poses: Array
    """T_body_taxel (n, 4, 4); z = outward normal, the rotation about it is a convention."""
    covariances: Array
    """(n, 6, 6) in the taxel's frame, translation first; inf where not determined."""
    observed: np.ndarray
    """(n, 6) bool: the degrees of freedom that the data and the named factors determined."""
    touched: np.ndarray
    """(n,) bool: whether the taxel gave any reading of a pressed contact."""
    readings: np.ndarray
    """Number of such readings (n,)."""
    method: str
    """Name of the estimator."""
    anchor: str
    """What fixes the pose of the whole."""
    factors: tuple[str, ...]
    """What the estimate is made of, priors named."""
    chi2: Array
    """Squared residuals per degree of freedom of each taxel (n,); NaN with none left."""
    reasons: np.ndarray
    """Why a taxel is not determined (n,) str; "" where it is."""
    modulus: float | None = None
    """E*, Pa, that the pressures were read under."""
    modulus_sigma: float | None = None
    """Its standard deviation, Pa, that by the indenter's radius included; None: it was given, not
    estimated."""
    unknowns: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Global parameters that were estimated: value and standard deviation, SI units; of modulus and
    force scale the natural logarithm of the factor to the nominal one (`parameter_values`). The
    deviations are those by the readings, with the believed indenter."""
    undetermined: tuple[str, ...] = ()
    """Directions of the global parameters that rest on the priors, in words."""
    taxel_unknowns: Mapping[str, Array] = field(default_factory=dict)
    """"gain" (ln) and "offset" (Pa) where estimated: value and standard deviation (n, 2)."""
    faults: np.ndarray | None = None
    """What is wrong with a taxel (n,) str, "" where nothing was found; None: not looked for."""
    rivals: Array | None = None
    """Other positions (n, 3), m, that fit the readings nearly as well, NaN where there is none; the
    covariance holds their distance as a standard deviation. None: not looked for."""
    fit: GoodnessOfFit | None = None
    """Whether the model explains the readings."""
    response: LearnedResponse | None = None
    """The learned response of the taxels; None: the contact model's."""
    verdict: Verdict | None = None
    """Whether the calibration can be relied on, with reasons; None: made by hand."""
    contact_centroids: Array | None = None
    """Pressure-weighted centroid (n, 3), m, of the contacts of each taxel; NaN without any."""
    belief: Belief | None = field(default=None, repr=False, compare=False)
    """What it was estimated under; not saved."""
    iterates: Array | None = None
    """Positions (k, n, 3), m, along the iterations; None where they were not kept."""
    seconds: Mapping[str, float] = field(default_factory=dict)
    """Seconds of the stages."""
    provenance: Mapping[str, Any] = field(default_factory=dict)
    """Inputs, versions, time."""

    def __repr__(self) -> str:
        found = np.isfinite(self.poses).all(axis=(1, 2))
        sigma = 1e3 * self.position_sigma[found]
        spread = f", {np.median(sigma):.3g} mm sigma" if found.any() else ""
        return (
            f"<Calibration by {self.method}: {found.sum()} of {len(self.ids)} taxels{spread}, "
            f"{self.readings.sum()} readings>"
        )

    @property
    def positions(self) -> Array:
        """Positions (n, 3), body frame, m; NaN where not determined."""
        return np.asarray(self.poses[:, :3, 3])

    @property
    def position_sigma(self) -> Array:
        """Standard deviation (n,), m, of the position in space (root of the trace)."""
        variance = np.diagonal(self.covariances, axis1=1, axis2=2)
        return np.asarray(np.sqrt(variance[:, :3].sum(axis=1)))

    def next_contacts(self, k: int = 1, belief: Belief | None = None) -> NextContacts:
        """The k contacts, ranked, that reduce the largest uncertainties most (next_contact.py).

        belief: as in `calibrate`; only a calibration that was loaded from a file needs it. Raises
        CalibrationError without one, for k < 1, or if no taxel was read.
        """
        from .next_contact import next_contacts

        belief = belief or self.belief
        if belief is None:
            raise CalibrationError(
                "a loaded calibration does not know the scene", remedy="give next_contacts a belief"
            )
        return next_contacts(self, belief, k)

    def cross_validate(
        self,
        recording: Recording,
        folds: int = 5,
        belief: Belief | None = None,
        progress: Progress | None = None,
    ) -> CrossValidation:
        """Errors of contacts that are localised by a skin calibrated without them, and by the
        centroid of the taxels that read (cross_validation.py); no truth is needed.

        recording: what was calibrated. belief: as in `calibrate`; only a calibration that was
        loaded from a file needs it. progress(stage, done, total): called after each fold. Raises
        CalibrationError without one, and for fewer blocks of
        contacts than folds; as `calibrate`.
        """
        from .cross_validation import cross_validate

        return cross_validate(self, recording, folds, belief, progress)

    @property
    def parameter_values(self) -> dict[str, tuple[float, float, str]]:
        """Value, standard deviation and unit of each of `unknowns` in natural units.

        The modulus is E* in Pa; a force scale is the factor of the true to the measured force.
        """
        out = {}
        for label, (value, sigma) in self.unknowns.items():
            name = label.split()[0]
            if label == "modulus" and self.modulus is not None:
                total = self.modulus_sigma or self.modulus * sigma
                out[label] = self.modulus, total, "Pa"
            elif name in LOGARITHMS or label == "hysteresis width":
                out[label] = float(np.exp(value)), float(np.exp(value)) * sigma, ""
            else:
                unit = UNITS.get(name, "rad" if "rotation" in label else "m")
                out[label] = value, sigma, unit
        return out

    def save(self, path: str | Path) -> None:
        """Write path.parquet, which `load` reads, and path.csv, a table for people (mm)."""
        path = Path(path)
        columns = {column: _column(getattr(self, name)) for name, column in _COLUMNS.items()}
        steps = 0 if self.iterates is None else len(self.iterates)
        if self.iterates is not None:
            columns["iterates"] = _column(np.swapaxes(self.iterates, 0, 1))
        if self.faults is not None:
            columns["faults"] = _column(self.faults)
        if self.contact_centroids is not None:
            columns["middles"] = _column(self.contact_centroids)
        if self.rivals is not None and np.isfinite(self.rivals).any():
            columns["rivals"] = _column(self.rivals)
        columns |= {
            _NUISANCE + name: _column(values) for name, values in self.taxel_unknowns.items()
        }
        header = {name: getattr(self, name) for name in _HEADER} | {"steps": steps}
        header["fit"] = None if self.fit is None else asdict(self.fit)
        header["verdict"] = None if self.verdict is None else asdict(self.verdict)
        header["response"] = None if self.response is None else self.response.values()
        table = pa.table(columns).replace_schema_metadata({_KEY: json.dumps(header).encode()})
        with atomic(_part(path, "parquet")) as temporary:
            pq.write_table(table, temporary)
        write_text(_part(path, "csv"), self.csv())

    @classmethod
    def load(cls, path: str | Path) -> Calibration:
        """Read what `save` wrote at `path`. Raises CalibrationError for other files."""
        file = _part(Path(path), "parquet")
        if not file.exists():
            raise CalibrationError(f"no calibration at {path}", remedy="check the path")
        try:
            table = pq.read_table(file)
        except (pa.ArrowInvalid, OSError) as error:
            raise CalibrationError(
                f"{file} cannot be read", value=str(error).splitlines()[0], remedy="calibrate again"
            ) from error
        metadata = table.schema.metadata or {}
        missing = set(_COLUMNS.values()) - set(table.column_names)
        if _KEY not in metadata or missing:
            raise CalibrationError(f"{file} holds no calibration", remedy="check the path")
        header = json.loads(metadata[_KEY])
        n, steps = table.num_rows, header.pop("steps")
        shapes = {"poses": (n, 4, 4), "covariances": (n, 6, 6), "observed": (n, 6)}
        values: dict[str, Any] = {
            name: _array(table, column).reshape(shapes.get(name, (n,)))
            for name, column in _COLUMNS.items()
        }
        if steps:
            values["iterates"] = np.swapaxes(_array(table, "iterates").reshape(n, steps, 3), 0, 1)
        if "faults" in table.column_names:
            values["faults"] = _array(table, "faults")
        if "middles" in table.column_names:
            values["contact_centroids"] = _array(table, "middles").reshape(n, 3)
        if "rivals" in table.column_names:
            values["rivals"] = _array(table, "rivals").reshape(n, 3)
        values["taxel_unknowns"] = {
            name.removeprefix(_NUISANCE): _array(table, name).reshape(n, 2)
            for name in table.column_names
            if name.startswith(_NUISANCE)
        }
        fit = header.pop("fit", None)
        header["fit"] = None if fit is None else GoodnessOfFit(**fit)
        if (verdict := header.pop("verdict", None)) is not None:
            header["verdict"] = Verdict(verdict["level"], tuple(verdict["reasons"]))
        if (response := header.pop("response", None)) is not None:
            header["response"] = LearnedResponse.from_values(response)
        header["unknowns"] = {k: tuple(v) for k, v in header.get("unknowns", {}).items()}
        for name in ("factors", "undetermined"):
            header[name] = tuple(header.get(name, ()))
        return cls(**values, **header)

    def csv(self) -> str:
        """A table in CSV: one row a taxel, lengths in mm, empty where not determined."""
        rows = ["taxel,x_mm,y_mm,z_mm,nx,ny,nz,sigma_mm,readings,note"]
        numbers = np.column_stack(
            [1e3 * self.positions, self.poses[:, :3, 2], 1e3 * self.position_sigma]
        )
        faults = np.full(len(self.ids), "") if self.faults is None else self.faults
        for k, values in enumerate(numbers):
            text = [f"{x:.6f}" if np.isfinite(x) else "" for x in values]
            note = "; ".join(filter(None, [self.reasons[k], faults[k].replace(",", ";")]))
            rows.append(",".join([str(self.ids[k]), *text, str(self.readings[k]), note]))
        return "\n".join(rows) + "\n"

    def report(self, path: str | Path, **options: Any) -> list[Path]:
        """Write the report page, `path`.html; options (truth=skin, recording=, ...) as
        `meshskin.report`.

        body: by default that of the belief; a calibration that was loaded has none. Returns the
        files written. Raises ConfigError for a path with another suffix than .html and for a truth
        that is not a Skin, UnknownNameError for an unknown option.
        """
        from ..report.page import report
        from ..skin.skin import Skin

        known = list(inspect.signature(report).parameters)
        for name in options:
            check_name("option of a report", name, known)
        if Path(path).suffix not in ("", ".htm", ".html"):
            raise ConfigError(
                "a report is an HTML page", value=str(path), remedy="give a path that ends in .html"
            )
        if options.get("truth") is not None:
            check_type(Skin, options["truth"], "the truth of a report")
        body = None if self.belief is None else self.belief.body
        return report(path, **{"body": body, "calibration": self, **options})


def _part(path: Path, suffix: str) -> Path:
    return path.with_name(f"{path.name.removesuffix('.parquet')}.{suffix}")


def _column(values: np.ndarray) -> pa.Array:
    """An Arrow column of the rows of `values` (n, ...), each row flat."""
    values = np.asarray(values)
    if values.ndim == 1:
        return pa.array(values.tolist() if values.dtype == object else values)
    flat = np.ascontiguousarray(values).reshape(len(values), -1)
    return pa.FixedSizeListArray.from_arrays(pa.array(flat.ravel()), flat.shape[1])


def _array(table: pa.Table, name: str) -> np.ndarray:
    column = table.column(name).combine_chunks()
    if isinstance(column, pa.ChunkedArray):
        column = column.chunk(0)
    if isinstance(column, pa.FixedSizeListArray):
        column = column.flatten()
    if pa.types.is_string(column.type):
        return np.array(column.to_pylist(), dtype=object)
    return np.array(column.to_numpy(zero_copy_only=False))
