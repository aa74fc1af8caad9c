"""What every estimator returns: taxel poses with their covariances, and what they rest on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from ..core.arrays import Array
from .uncertainty.goodness_of_fit import GoodnessOfFit

CONTACT_POINTS = "contact points in the body frame"
"""The gauge of an estimate that rests on the recorded contact points."""
SURFACE = "body surface: position along the normal and tilt"
"""The factor of an estimate whose taxels lie on the believed surface."""


@dataclass(frozen=True)
class EstimatorResult:
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
    factors: tuple[str, ...] = ()
    """What the estimate is made of, priors named."""
    anchor: str = CONTACT_POINTS
    """What fixes the pose of the whole."""
    pose_covariances: Array | None = None
    """(n, 6, 6) in the taxels' frames, translation first; None: they follow from `covariance` and
    the surface's curvature."""
    modulus: float | None = None
    """E*, Pa."""
    modulus_sigma: float | None = None
    """Its standard deviation, Pa; None where it was given."""
    unknowns: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Value and standard deviation of each global parameter, as `GlobalParameters.labels`."""
    undetermined: tuple[str, ...] = ()
    """Directions of the global parameters that rest on the priors, in words."""
    taxel_unknowns: Mapping[str, Array] = field(default_factory=dict)
    """"gain" (ln) and "offset" (Pa) where estimated: value and standard deviation (n, 2)."""
    faults: np.ndarray | None = None
    """What is wrong with a taxel (n,) str; "" where nothing was found; None: not looked for."""
    rivals: Array | None = None
    """Other positions (n, 3), m, that fit the readings nearly as well; NaN where there is none. The
    covariance then holds the distance as a standard deviation."""
    fit: GoodnessOfFit | None = None
    """Whether the model explains the readings."""
    iterates: Array | None = None
    """Positions (k, n, 3), m, along the iterations, the start first."""
    restarted: np.ndarray = field(default_factory=lambda: np.empty(0, dtype=int))
    """Rows of taxels that were started again from the centroid of their contacts."""
    seconds: Mapping[str, float] = field(default_factory=dict)
    """Seconds of the stages."""

    @property
    def found(self) -> np.ndarray:
        """Whether each taxel is determined (n,) bool."""
        return np.asarray(self.reasons == "")
