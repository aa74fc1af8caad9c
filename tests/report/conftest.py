"""A made-up run on the paper's sphere whose numbers are known: what the report's tests read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pytest

from meshskin.core.se3 import transform
from meshskin.estimation.calibration import Calibration
from meshskin.recording.recording import Recording
from meshskin.skin.skin import Skin
from meshskin.study.sensitivity.cost import Costs, Row, Setting

RADIUS = 0.1
COUNT = 80
UNTOUCHED = (3, 40)


def poses(count: int = COUNT) -> np.ndarray:
    """Taxels (n, 4, 4) on a spiral about the sphere's lowest point, about 5 mm apart."""
    k = np.arange(count)
    polar, azimuth = 2.85e-3 * np.sqrt(k + 0.5) / RADIUS, 2.39996 * k
    z = np.stack(
        [np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), -np.cos(polar)], axis=1
    )
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return transform(np.stack([x, np.cross(z, x), z], axis=2), RADIUS * z)


def skin(count: int = COUNT) -> Skin:
    """The truth."""
    return Skin(poses(count), np.arange(count))


def calibration(sigma: float = 1e-5, method: str = "joint", seed: int = 0) -> Calibration:
    """An estimate of `skin()`, N(0, sigma^2) off along the skin, with two taxels untouched."""
    rng = np.random.default_rng(seed)
    true = poses()
    estimate = true.copy()
    offset = np.zeros((COUNT, 3))
    offset[:, :2] = sigma * rng.normal(size=(COUNT, 2))
    estimate[:, :3, 3] += (true[:, :3, :3] @ offset[:, :, None])[:, :, 0]
    covariances = np.zeros((COUNT, 6, 6))
    covariances[:, [0, 1, 3, 4], [0, 1, 3, 4]] = sigma**2
    covariances[:, 5, 5] = np.inf
    touched = np.ones(COUNT, dtype=bool)
    touched[list(UNTOUCHED)] = False
    estimate[~touched] = np.nan
    covariances[~touched] = np.inf
    observed = np.tile([True] * 5 + [False], (COUNT, 1)) & touched[:, None]
    readings = np.where(touched, rng.integers(20, 400, COUNT), 0)
    steps = np.array([0.0, 0.5, 0.9, 1.0])[:, None, None] * estimate[None, :, :3, 3]
    return Calibration(
        ids=np.arange(COUNT), poses=estimate,
        covariances=covariances, observed=observed, touched=touched, readings=readings,
        method=method, anchor="body surface", factors=("pressure", "surface"),
        modulus=263158.0, modulus_sigma=120.0, chi2=np.where(touched, 1.0, np.nan),
        iterates=steps, reasons=np.where(touched, "", "never touched").astype(object),
        seconds={"build": 0.05, "solve": 0.07, "total": 0.12}, provenance={"seed": seed},
    )  # fmt: skip


def recording(motion: bool = True) -> Recording:
    """Contacts on back-and-forth passes, and a force that settles on 3 N in about 45 ms."""
    s = np.linspace(0.0, 1.0, 2000)
    polar_x, polar_y = 0.26 * (2 * s - 1), 0.26 * np.sin(40 * s)
    n = np.stack([np.sin(polar_x), np.sin(polar_y), -np.ones_like(s)], axis=1)
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    time = 0.5 + 9.5 * s
    columns = dict(zip(("px", "py", "pz"), (RADIUS * n).T, strict=True))
    columns |= dict(zip(("nx", "ny", "nz"), n.T, strict=True))
    contacts = pa.table({"time": time, **columns, "force": np.full(len(s), 3.0)})
    readings = pa.table(
        {
            "time": time,
            "taxel": pa.array(np.arange(len(s)) % COUNT, pa.int32()),
            "pressure": np.full(len(s), 4e4),
        }
    )
    t = np.arange(0.0, 10.0, 1e-3)
    force = 3.0 * (1 - np.exp(-np.maximum(t - 0.3, 0.0) / 0.015))
    force += np.where(t > 0.6, 0.004 * np.sin(20 * t), 0.0)
    phase = np.where(t > 0.6, "slide", "touch")
    table = pa.table({"time": t, "force": force, "reference": np.full(len(t), 3.0), "phase": phase})
    metadata = {
        "scene": "sphere <made up>", "seed": 1, "disc_radius_m": 2e-3, "threshold_pa": 10.0,
        "taxel_ids": list(range(COUNT)),
    }  # fmt: skip
    return Recording(contacts, readings, metadata, table if motion else None)


def costs(methods: Sequence[str], seconds: Sequence[float], errors_mm: Sequence[float]) -> Costs:
    """Costs of a scene with other estimators, without numerical part."""
    own = Setting(None, 4, "hertz", 1e-3, "rk4", 3e-3, 100.0)
    rows = [Row("scene", own, 0.01, 0.0, located=COUNT, seconds={"simulate": 0.3})]
    for method, time, error in zip(methods, seconds, errors_mm, strict=True):
        changed, spent = replace(own, method=method), {"simulate": time}
        rows.append(Row("method", changed, error, 0.0, located=COUNT, seconds=spent))
    return Costs("made up", own, own, tuple(rows), (), 1)


METRICS = {
    "taxels": COUNT,
    "touched": COUNT - len(UNTOUCHED),
    "position_error_mm": {"mean": 0.01234, "rms": 0.0141, "max": 0.0333},
    "trilateration": {"mean": 0.251, "rms": 0.3, "max": 0.9},
    "posegraph": {"mean": 0.0871, "rms": 0.1, "max": 0.3},
    "crlb_mm": {"mean": 0.0121, "rms": 0.0137},
    "nees": 1.98,
    "force": {
        "reference_n": 3.0, "mean_n": 3.0012, "std_n": 0.003, "overshoot": 0.0,
        "settling_s": 0.0449,
    },
    "steps_per_second": 41234.0,
}  # fmt: skip


@pytest.fixture(scope="session")
def case() -> SimpleNamespace:
    """The made-up run, by name."""
    return SimpleNamespace(
        RADIUS=RADIUS, COUNT=COUNT, UNTOUCHED=UNTOUCHED, METRICS=METRICS,
        skin=skin, calibration=calibration, recording=recording, costs=costs,
    )  # fmt: skip
