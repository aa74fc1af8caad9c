"""What every estimator returns: taxel poses with their covariances, and what they rest on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from ..core.arrays import Array
from ..core.value import Value
from .uncertainty.goodness_of_fit import GoodnessOfFit

if TYPE_CHECKING:
    from .learned.start import Former

MOSTLY_OUTLIERS = "most of its readings are outlying"
"""Reason of a taxel whose estimate is dropped; its fault says what was found."""
RIVAL = "a second position {:.2g} mm away fits nearly as well"
"""Fault of a taxel whose readings have two optima."""
SHARED_ERRORS = "errors shared by the readings of contacts near one another {}"
"""Factor of an estimate whose standard deviations include such errors."""
OTHER_RESPONSE = (
    "another response (saturation, exponent or size of the patch) of {} than of the others"
)
"""Departure of an estimate, with the taxels that differ."""
ALIKE_CONTACTS = "errors of the contact points that are alike over the body"
"""Factor of an estimate whose standard deviations include a field of such errors."""
CENSORING = "silent readings, censored at the threshold"
"""Factor of an estimate with known noise."""
CONTACT_POINTS = (
    "contact points in the body frame, by the believed pose of the body, whose error moves all "
    "positions alike"
)
"""The gauge of an estimate that rests on the recorded contact points."""
SHOWN_RANGES = 4
"""Ranges of taxel ids that are listed in words; a module is one range."""
SURFACE = "body surface: position along the normal and tilt"
"""The factor of an estimate whose taxels lie on the believed surface."""


def name_rivals(faults: np.ndarray, rows: np.ndarray, points: Array, rivals: Array) -> None:
    """Add the second positions `rivals` (k, 3), m, NaN where there is none, of the taxels `rows`
    (k,) at `points` (k, 3), m, to their faults (n,)."""
    distance = np.linalg.norm(rivals - points, axis=1)
    for k in np.flatnonzero(np.isfinite(distance)):
        faults[rows[k]] = join_words(faults[rows[k]], RIVAL.format(1e3 * distance[k]))


def join_words(*words: str) -> str:
    """Several faults of a taxel as one text; empty ones are left out."""
    return ", ".join(filter(None, words))


def ids_in_words(ids: np.ndarray) -> str:
    """Rising taxel ids as ranges, the first SHOWN_RANGES of them."""
    parts = np.split(ids, np.flatnonzero(np.diff(ids) > 1) + 1)
    words = [f"{part[0]} to {part[-1]}" if len(part) > 1 else f"{part[0]}" for part in parts]
    more = sum(len(part) for part in parts[SHOWN_RANGES:])
    return ", ".join(words[:SHOWN_RANGES]) + (f" and {more} more" if more else "")


@dataclass(frozen=True, eq=False)
class LearnedResponse(Value):
    """The learned response of the taxels, at the median force, in the unit of the readings."""

    distance: Array
    """Distances (q,), m, from the contact point."""
    profile: Array
    """Reading (q,) of a taxel there, before compression."""
    profile_sigma: Array
    """Its standard deviation (q,)."""
    model: Array
    """The believed model's (q,), with the learned size and scale."""
    level: Array
    """Levels (q,) before compression."""
    reading: Array
    """Readings (q,) of these levels."""
    reading_sigma: Array
    """Their standard deviation (q,)."""
    contact_scatter: float
    """Standard deviation of the contact points along each tangent, m."""
    contact_correlation: float
    """Correlation of the displacements of neighbouring contacts."""
    force_scatter: float
    """Standard deviation of the errors of ln force, as of forces that change the readings as much:
    errors of the amplitude of whole patches count here, too, by their effect."""
    noise: float
    """Standard deviation of a reading, its constant part."""
    noise_relative: float
    """Its part proportional to the reading."""
    edge_error: float = 0.0
    """Rms error of the readings over edges of the body, relative to its heights over quadrics there
    and the peak (`patch_shape.unevenness`); 1 exactly where no contacts tell it."""
    alike_contacts: float = 1.0
    """Factor of the variances by errors that neighbouring contacts share; 1 where chance explains
    them (learned/contact_correlations.py)."""
    alike_parts: tuple[float, ...] = (0.0, 0.0, 0.0)
    """What displacements of contact points and errors of forces and of readings have in it."""
    coefficients: Array = field(default_factory=lambda: np.empty(0))
    """Whitened coefficients of the profile's correction (contact/learned.py)."""
    extent: float = 2.5
    """Distance, in semi-axes of the patch, from which the correction is zero."""
    levels: tuple[float, float] = (0.5, 0.5)
    """`Measurements.response_levels`."""
    unit: float = 1.0
    """Recorded unit per nominal Pa; 1 exactly where the readings are pressures."""
    hysteresis: tuple[float, float] = (0.0, 0.0)
    """Share of a play operator in the readings, and its half-width relative to the nominal peak
    (joint/electronics.py); zeros where the readings show none."""
    crosstalk: float = 0.0
    """Share of the pressure of each neighbour, or of other taxels near it, in a reading."""
    leaking: float = 1.0
    """1 where all neighbours crosstalk; else the part that does of the pairs of near taxels."""
    drift: float = 0.0
    """Standard deviation over the taxels of the change of their offsets during the recording."""
    skew: float = 0.0
    """Standard deviation, m, over the taxels of how far contacts move until their channels are read
    one after another."""
    creep: tuple[float, float] = (0.0, 0.0)
    """Share of a held reading that follows the pressure, and its time constant, s
    (joint/electronics.py); zeros where the readings show none."""
    gain_drift: float = 0.0
    """Largest change of the gain of all taxels during the recording, relative."""
    offset_drift: float = 0.0
    """Largest change of the offset of all taxels during the recording."""
    force_drift: float = 0.0
    """Largest change of the true over the measured forces during the recording, relative."""
    contact: str = "hertz"
    """Contact model that the response corrects."""
    references: tuple[float, ...] = ()
    """Force, N, relative curvature, 1/m, peak pressure and E*, Pa, that the response refers to;
    empty in files that were written before it was stated."""
    taxels: np.ndarray = field(default_factory=lambda: np.empty(0, dtype=int))
    """Ids of the taxels of this group; empty where all taxels respond alike."""
    others: tuple[LearnedResponse, ...] = ()
    """Responses of the further groups of taxels, whose scatter, noise and electronics are these."""

    @property
    def each(self) -> tuple[LearnedResponse, ...]:
        """The responses of all groups."""
        return self, *self.others

    @property
    def unit_name(self) -> str:
        """Unit of the readings: "Pa", or "counts" of raw ones."""
        return "Pa" if self.unit == 1.0 else "counts"

    def metrics(self) -> dict[str, Any]:
        """The estimated variances, for metrics.json."""
        return {
            "contact_scatter_mm": 1e3 * self.contact_scatter,
            "contact_correlation": self.contact_correlation,
            "force_scatter_percent": 100 * self.force_scatter,
            "alike_contacts": self.alike_contacts,
            "noise": self.noise,
            "noise_percent": 100 * self.noise_relative,
            "edge_error": self.edge_error,
            "unit": self.unit_name,
            "hysteresis_share": self.hysteresis[0],
            "hysteresis_width": self.hysteresis[1],
            "crosstalk": self.crosstalk,
            "leaking": self.leaking,
            "drift": self.drift,
            "skew_mm": 1e3 * self.skew,
            "creep_share": self.creep[0],
            "creep_time_s": self.creep[1],
            "gain_drift": self.gain_drift,
            "offset_drift": self.offset_drift,
            "force_drift": self.force_drift,
            "groups": [ids_in_words(one.taxels) for one in self.each if len(one.taxels)],
        }

    def values(self) -> dict[str, Any]:
        """The fields as JSON values."""
        found = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in vars(self).items()}
        return {**found, "others": [other.values() for other in self.others]}

    @classmethod
    def from_values(cls, values: Mapping[str, Any]) -> LearnedResponse:
        """What `values` gave; names of other versions are left out."""
        known = cls.__dataclass_fields__.keys() & values.keys()
        arrays: dict[str, Any] = {
            k: np.array(values[k]) if isinstance(values[k], list) else values[k] for k in known
        }
        for name in arrays.keys() & {"levels", "hysteresis", "creep", "references", "alike_parts"}:
            arrays[name] = tuple(map(float, arrays[name]))
        arrays["taxels"] = np.array(values.get("taxels", ()), dtype=int)
        others = tuple(cls.from_values(other) for other in values.get("others", ()))
        return cls(**{**arrays, "others": others})

    def describe(self) -> tuple[str, ...]:
        """One sentence for each variance, and each departure that the readings show."""
        noun, (share, width), creep = self.unit_name, self.hysteresis, self.creep
        leak = "each neighbour's pressure"
        if self.leaking != 1:
            leak = f"another taxel's pressure, in {100 * self.leaking:.2g} % of the near pairs"
        groups = "; ".join(ids_in_words(one.taxels) for one in self.each if len(one.taxels))
        departures = {
            f"readings over edges of the body err by {self.edge_error:.2g} of the peak where the "
            "heights there are one depth of the contact": self.edge_error not in (0.0, 1.0),
            f"hysteresis: {100 * share:.2g} % of a reading follows the pressure at a distance of "
            f"{100 * width:.2g} % of the nominal peak": share,
            f"crosstalk: {100 * self.crosstalk:.2g} % of {leak}": self.crosstalk,
            f"offsets drift by {self.drift:.2g} {noun} during the recording (1 sigma)": self.drift,
            f"taxels are not read at once: a contact moves by {1e3 * self.skew:.2g} mm between "
            "them (1 sigma)": self.skew,
            f"creep: {100 * creep[0]:.2g} % of a held reading follows the pressure with a time "
            f"constant of {creep[1]:.2g} s": creep[0],
            f"the gain of all taxels drifts by {100 * self.gain_drift:.2g} %": self.gain_drift,
            f"the offset of all taxels drifts by {self.offset_drift:.2g} {noun}": self.offset_drift,
            f"the measured forces drift by {100 * self.force_drift:.2g} %": self.force_drift,
            f"{len(self.each)} groups of taxels have responses of their own: {groups}": self.others,
        }
        return (
            f"contact points scatter by {1e3 * self.contact_scatter:.2g} mm along each tangent",
            f"forces scatter by {100 * self.force_scatter:.2g} %",
            f"readings have noise of {self.noise:.3g} {noun} and "
            f"{100 * self.noise_relative:.2g} % of the level",
            *(words for words, shows in departures.items() if shows),
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class EstimateDetails:
    """What an estimate of n taxels rests on, and what was estimated beside their poses."""

    factors: tuple[str, ...] = ()
    """What the estimate is made of, priors named."""
    anchor: str = CONTACT_POINTS
    """What fixes the pose of the whole."""
    modulus: float | None = None
    """E*, Pa, that the pressures were read under."""
    modulus_sigma: float | None = None
    """Its standard deviation, Pa, that by the indenter's radius included; None: it was given, not
    estimated."""
    unknowns: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Global parameters that were estimated: value and standard deviation, SI units; of modulus and
    force scale the natural logarithm of the factor to the nominal one
    (`Calibration.parameter_values`). The deviations are those by the readings, with the believed
    indenter."""
    undetermined: tuple[str, ...] = ()
    """Directions of the global parameters that rest on the priors, in words."""
    taxel_unknowns: Mapping[str, Array] = field(default_factory=dict)
    """"gain" (ln), "offset", "drift" (Pa) and "skew" (m) where estimated: value and standard
    deviation (n, 2)."""
    faults: np.ndarray | None = None
    """What is wrong with a taxel (n,) str, "" where nothing was found; None: not looked for."""
    rivals: Array | None = None
    """Other positions (n, 3), m, that fit the readings nearly as well, NaN where there is none; the
    covariance holds their distance as a standard deviation. None: not looked for."""
    fit: GoodnessOfFit | None = None
    """Whether the model explains the readings."""
    response: LearnedResponse | None = None
    """The learned response of the taxels; None: the contact model's."""
    contact_errors: Array | None = None
    """Errors (m, 3) of the m pressed contacts that were estimated with a learned response: by how
    much a point is displaced along the first and second principal direction, m, and of ln F; None
    without one. Not saved."""
    additions: Array | None = None
    """Rows (k, 3) of contact, row of the taxel, and what hysteresis, creep, crosstalk and drifts
    add to its reading there, in Pa under the response; None without these. Not saved."""
    iterates: Array | None = None
    """Positions (k, n, 3), m, along the iterations, the start first; None where not kept."""
    seconds: Mapping[str, float] = field(default_factory=dict, compare=False)
    """Seconds of the stages."""


@dataclass(frozen=True)
class EstimatorResult(EstimateDetails):
    """Estimates of n taxels, body frame, SI units; NaN or inf where a taxel is not determined."""

    points: Array
    """Positions (n, 3), m."""
    rotations: Array
    """(n, 3, 3), taxel frame to body frame: z is the outward normal, or that of the module; of a
    taxel without a module the rotation about it is a convention."""
    covariance: Array
    """(n, 2, 2) in the tangent plane, m^2; inf on the diagonal where undetermined."""
    chi2: Array
    """Squared residuals per degree of freedom (n,); NaN with none left."""
    reasons: np.ndarray
    """Why a taxel is undetermined (n,) str; "" where it is determined."""
    pose_covariances: Array | None = None
    """(n, 6, 6) in the taxels' frames, translation first; None: they follow from `covariance` and
    the surface's curvature."""
    departures: Mapping[str, float] = field(default_factory=dict)
    """Score, in standard deviations, of each departure from the model that was tested
    (joint/departures.py)."""
    jump: Array = field(default_factory=lambda: np.zeros(6))
    """Motion (6,) of the contacts from one on (`joint.jump.Jump.motion`), where the readings show
    one."""
    restarted: np.ndarray = field(default_factory=lambda: np.empty(0, dtype=int))
    """Rows of taxels that were started again from the centroid of their contacts."""
    former: Former | None = None
    """What an estimate of the same taxels can begin from (learned/start.py); None: nothing."""

    @property
    def found(self) -> np.ndarray:
        """Whether each taxel is determined (n,) bool."""
        return np.asarray(self.reasons == "")

    @property
    def details(self) -> dict[str, Any]:
        """The fields of EstimateDetails by name."""
        return {f.name: getattr(self, f.name) for f in fields(EstimateDetails)}
