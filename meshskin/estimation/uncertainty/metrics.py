"""Errors against a known skin, and whether the stated covariances hold."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

import numpy as np
from scipy.special import gammaincinv

from ...core import se3
from ...core.arrays import Array
from ...core.errors import CalibrationError
from ...recording.recording import Recording
from ...scene.belief import Belief
from ...skin.skin import Skin
from ..calibration import Calibration
from .observability import cramer_rao, true_positions

MIN_ALIGNED = 3
"""Fewest taxels that determine a rigid alignment."""


def position_errors(calibration: Calibration, skin: Skin, gauge: bool = False) -> Array:
    """Distances (n,), m, from the true positions of `skin`; NaN for taxels that are undetermined.

    gauge: after the rigid alignment that fits best, for a method that does not determine the pose
    of the whole. Raises CalibrationError if fewer than three taxels could be aligned.
    """
    truth, found = true_positions(skin, calibration.ids), calibration.positions
    if gauge:
        good = np.isfinite(found).all(axis=1)
        if good.sum() < MIN_ALIGNED:
            raise CalibrationError(
                "a rigid alignment needs three taxels",
                value=f"{good.sum()} determined",
                limit=f"at least {MIN_ALIGNED}",
                remedy="touch more taxels",
            )
        pose = se3.align(found[good], truth[good])
        found = se3.transform_points(pose, found)
    return np.asarray(np.linalg.norm(found - truth, axis=1))


def summary_mm(errors: Array) -> dict[str, float]:
    """Mean, rms and max, mm, of errors (n,), m; NaN entries are left out."""
    e = 1e3 * errors[np.isfinite(errors)]
    if not len(e):
        return dict.fromkeys(("mean", "rms", "max"), float("nan"))
    return {"mean": float(e.mean()), "rms": float(np.sqrt(np.mean(e**2))), "max": float(e.max())}


def nees(calibration: Calibration, skin: Skin) -> Array:
    """Normalized squared error (n,) along the surface: 2 on average where the covariance holds.

    NaN for a taxel whose position along the surface is not determined.
    """
    error = true_positions(skin, calibration.ids) - calibration.positions
    out = np.full(len(error), np.nan)
    good = calibration.observed[:, :2].all(axis=1)
    local = np.einsum("nji,nj->ni", calibration.poses[good, :3, :3], error[good])[:, :2]
    solved = np.linalg.solve(calibration.covariances[good, :2, :2], local[:, :, None])[:, :, 0]
    out[good] = np.einsum("ni,ni->n", local, solved)
    return out


IDEAL_SIGMA = 1e-7
"""Stated standard deviation (m), median, below which the readings were ideal, and errors are those
of arithmetic: the scene sphere, without noise, has 1e-9, and sphere_noisy 1e-5."""


def is_ideal(calibration: Calibration) -> bool:
    """Whether the readings had no noise, so that the NEES has no distribution."""
    sigma = calibration.position_sigma[np.isfinite(calibration.position_sigma)]
    return bool(len(sigma) and np.median(sigma) < IDEAL_SIGMA)


def nees_band(count: int, confidence: float = 0.95) -> tuple[float, float]:
    """The interval of the mean NEES of `count` independent taxels at this confidence.

    Source: Bar-Shalom, Li, Kirubarajan, "Estimation with Applications to Tracking and Navigation"
    (2001), section 5.4.
    """
    tail = (1 - confidence) / 2
    low, high = (float(2 * gammaincinv(count, p) / count) for p in (tail, 1 - tail))
    return low, high


def bound_mm(
    recording: Recording, belief: Belief, skin: Skin, located: np.ndarray | None = None
) -> dict[str, float]:
    """The Cramér-Rao bound at the truth `skin`: mean and rms error, mm; zero without noise.

    located: ids (k,) of the taxels that it is the mean of: those with an estimate, to compare it
    with their error (a taxel that is hardly determined can have a bound of centimetres); None, or
    none: all that have a bound.
    """
    if belief.noise_sigma is None:
        return {"mean": 0.0, "rms": 0.0}
    limit = cramer_rao(recording, belief, skin)
    if located is not None and len(located):
        limit = replace(limit, covariance=limit.covariance[np.isin(belief.taxel_ids, located)])
    return {"mean": 1e3 * limit.mean, "rms": 1e3 * limit.rms}


def undetermined(calibration: Calibration) -> str:
    """Taxels and degrees of freedom that the data did not determine, in words."""
    missing = ~calibration.observed
    whole = missing.all(axis=1)
    parts = []
    if whole.any():
        ids = ", ".join(str(k) for k in calibration.ids[whole][:10])
        plural = "s" if whole.sum() > 1 else ""
        parts.append(
            f"{int(whole.sum())} taxel{plural} ({ids}{', ...' if whole.sum() > 10 else ''})"
        )
    names = ("x", "y", "z", "tilt about x", "tilt about y", "rotation about the normal")
    for k, name in enumerate(names):
        count = int((missing[:, k] & ~whole).sum())
        if count:
            parts.append(f"{name} of {'every taxel' if count == (~whole).sum() else count}")
    return "; ".join(parts) if parts else "nothing"


def without_truth(calibration: Calibration, recording: Recording) -> dict[str, Any]:
    """What metrics.json holds of every calibration; the digest is that of its recording."""
    response = calibration.response
    return {
        "verdict": None if calibration.verdict is None else asdict(calibration.verdict),
        "taxels": len(calibration.ids),
        "touched": int(calibration.touched.sum()),
        "contacts": len(recording.time),
        "readings": int(calibration.readings.sum()),
        "recording_digest": recording.digest,
        "undetermined": undetermined(calibration),
        "modulus_pa": calibration.modulus,
        "modulus_sigma_pa": calibration.modulus_sigma,
        "response": None if response is None else response.metrics(),
    }
