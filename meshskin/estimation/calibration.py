"""The calibration: poses of all taxels with covariances, and what the data did not determine."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from ..core.arguments import check_name, check_type
from ..core.arrays import Array
from ..core.errors import CalibrationError, ConfigError
from ..core.notebook import Card, Tabular
from ..core.progress import Progress
from ..core.provenance import digest, provenance
from ..core.value import Value
from ..recording.recording import Recording
from ..scene.belief import Belief
from ..skin.files.table import DISC_RADIUS
from ..skin.skin import Skin
from . import calibration_file
from .data.global_parameters import natural_units
from .result import EstimateDetails
from .uncertainty.verdict import Verdict

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from .cross_validation import CrossValidation
    from .next_contact import NextContacts

READABLE = {
    "rad": (180 / np.pi, "degrees"),
    "m": (1e3, "mm"),
    "s": (1e3, "ms"),
    "Pa": (1e-3, "kPa"),
}
"""Factors and names of the units of `Calibration.parameter_words`."""
PATCH = "patch stiffness"
"""Name there of the factor on the believed E* that the size of the patches shows; it is the modulus
where readings in a unit of their own tell no E*."""


@dataclass(frozen=True, eq=False)
class Calibration(Value, Card, Tabular, EstimateDetails):
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
    chi2: Array
    """Squared residuals per degree of freedom of each taxel (n,); NaN with none left."""
    reasons: np.ndarray
    """Why a taxel is not determined (n,) str; "" where it is."""
    anchor: str = field(kw_only=True)
    """What fixes the pose of the whole."""
    factors: tuple[str, ...] = field(kw_only=True)
    """What the estimate is made of, priors named."""
    verdict: Verdict | None = None
    """Whether the calibration can be relied on, with reasons; None: made by hand."""
    contact_centroids: Array | None = None
    """Pressure-weighted centroid (n, 3), m, of the contacts of each taxel; NaN without any."""
    belief: Belief | None = field(default=None, repr=False, compare=False)
    """What it was estimated under; not saved."""
    provenance: Mapping[str, Any] = field(default_factory=dict)
    """Inputs, versions, time."""
    disc_radius: float = DISC_RADIUS
    """Radius of the taxels' discs, m, as it was believed."""
    frame: str | None = None
    """Name of the body frame: that of the believed body, a link of a robot or a mesh."""

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

    @property
    def skin(self) -> Skin:
        """The taxels that are determined, with their sigmas, ready to be saved.

        Raises CalibrationError where none is.
        """
        good = np.isfinite(self.poses).all(axis=(1, 2))
        if not good.any():
            raise CalibrationError("no taxel is determined, so there is no skin")
        sigmas = self.position_sigma[good]
        return Skin(self.poses[good], self.ids[good], self.disc_radius, sigmas, self.frame)

    @property
    def reasons_left_out(self) -> list[str]:
        """Why each taxel without an estimate has none."""
        return list(map(str, self.reasons[~np.isfinite(self.positions).all(axis=1)]))

    def facts(self) -> dict[str, str]:
        """Verdict, taxels, sigmas and what was estimated beside them, for a notebook."""
        found = np.isfinite(self.poses).all(axis=(1, 2))
        facts = {"method": self.method, "taxels": f"{found.sum()} of {len(self.ids)} determined"}
        if self.verdict is not None:
            facts = {"verdict": str(self.verdict).removeprefix("verdict: ")} | facts
        sigma = 1e3 * self.position_sigma[found]
        if len(sigma):
            facts["sigma"] = f"median {np.median(sigma):.3g} mm, largest {sigma.max():.3g} mm"
        facts["readings"] = f"{self.readings.sum():,}"
        facts |= self.parameter_words("\u00b1")
        if self.fit is not None:
            facts["test of fit"] = self.fit.words
        lost = Counter(self.reasons_left_out).most_common()
        words = "; ".join(f"{count}: {why}" for why, count in lost)
        return facts | ({"left out": words} if words else {})

    def plot(self, ax: Axes | None = None) -> Figure:
        """Draw the estimates, coloured by their sigmas, on the believed body where it is known.

        ax: matplotlib axes; None: those of a new figure. Raises CalibrationError where no taxel is
        determined.
        """
        body = None if self.belief is None else self.belief.body
        return self.skin.plot(ax, body, close=True)

    def to_arrow(self) -> pa.Table:
        """One row a taxel: taxel, x, y, z (m), nx, ny, nz, sigma (m), sigma_x, sigma_y, sigma_z (m,
        taxel's frame), readings, touched, chi2, reason and fault.

        Numbers are NaN or inf where the data did not determine them.
        """
        deviations = np.sqrt(np.diagonal(self.covariances, axis1=1, axis2=2)[:, :3])
        numbers = np.column_stack(
            [self.positions, self.poses[:, :3, 2], self.position_sigma, deviations]
        )
        names = ("x", "y", "z", "nx", "ny", "nz", "sigma", "sigma_x", "sigma_y", "sigma_z")
        faults = np.full(len(self.ids), "") if self.faults is None else self.faults
        table = {"taxel": self.ids, **dict(zip(names, numbers.T, strict=True))}
        table |= {"readings": self.readings, "touched": self.touched, "chi2": self.chi2}
        texts = {"reason": self.reasons, "fault": faults}
        return pa.table(table | {k: pa.array(list(v), pa.string()) for k, v in texts.items()})

    def next_contacts(
        self, k: int = 1, belief: Belief | None = None, progress: Progress | None = None
    ) -> NextContacts:
        """The k contacts, ranked, that reduce the largest uncertainties most (next_contact.py).

        belief: as in `calibrate`; only a calibration that was loaded from a file needs it.
        progress("next contacts", done, total): called after each. Raises CalibrationError without
        a belief, for k < 1, or if no taxel was read.
        """
        from .data.raw_readings import in_nominal_unit
        from .next_contact import next_contacts

        belief = self.belief if belief is None else in_nominal_unit(belief, self.response)
        if belief is None:
            raise CalibrationError(
                "a loaded calibration does not know the scene", remedy="give next_contacts a belief"
            )
        return next_contacts(self, belief, k, progress)

    def cross_validate(
        self,
        recording: Recording,
        folds: int = 5,
        belief: Belief | None = None,
        progress: Progress | None = None,
    ) -> CrossValidation:
        """Errors of contacts that are localized by a skin calibrated without them, and by the
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
        return natural_units(self.unknowns, self.modulus, self.modulus_sigma)

    def parameter_words(self, between: str = "+-") -> dict[str, str]:
        """`parameter_values` in words, in degrees, mm, ms and kPa; `between`: value and standard
        deviation. The modulus of a learned response is named PATCH: it is not E*."""
        words = {}
        for name, (value, sigma, unit) in self.parameter_values.items():
            if self.modulus is None and name.startswith("modulus"):
                name = name.replace("modulus", PATCH, 1)
            factor, shown = READABLE.get(unit, (1.0, unit))
            words[name] = f"{factor * value:.4g} {between} {factor * sigma:.2g} {shown}".rstrip()
        return words

    def save(self, path: str | Path) -> None:
        """Write path.parquet, which `load` reads, and path.csv, a table for people (mm)."""
        calibration_file.write(self, path)

    @classmethod
    def load(cls, path: str | Path) -> Calibration:
        """Read what `save` wrote at `path`. Raises CalibrationError for other files."""
        return calibration_file.read(path, cls)

    def csv(self) -> str:
        """A table in CSV: one row a taxel, lengths in mm, empty where not determined."""
        return calibration_file.csv(self)

    def report(self, path: str | Path, **options: Any) -> list[Path]:
        """Write the report page, `path`.html; options (truth=skin, recording=, ...): fields of
        report.data.ReportData, and those of report.page.report.

        body: by default that of the belief; a calibration that was loaded has none. Returns the
        files written. Raises ConfigError for a path with another suffix than .html and for a truth
        that is not a Skin, UnknownNameError for an unknown option.
        """
        from ..report.page import OPTIONS, report

        for name in options:
            check_name("option of a report", name, OPTIONS)
        if Path(path).suffix not in ("", ".htm", ".html"):
            raise ConfigError(
                "a report is an HTML page", value=str(path), remedy="give a path that ends in .html"
            )
        if options.get("truth") is not None:
            check_type(Skin, options["truth"], "the truth of a report")
        body = None if self.belief is None else self.belief.body
        return report(path, **{"body": body, "calibration": self, **options})


def provenance_of(method: str, recording: Recording) -> dict[str, Any]:
    """The provenance of a calibration of `recording` by `method`."""
    return provenance(
        method=method,
        recording=digest(recording.points, recording.force, recording.pressure),
        source=recording.metadata.get("provenance", {}),
    )
