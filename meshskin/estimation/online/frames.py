"""Contacts as an online calibration takes them: one or several frames, without a table."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...core.arguments import check_array, check_vectors
from ...core.arrays import Array
from ...core.errors import RecordingError
from ...core.value import Value


@dataclass(frozen=True, eq=False)
class ContactFrames(Value):
    """B frames of contact. Raises RecordingError for arrays of other shapes.

    Frames without contact have the force 0, or are left out.
    """

    points: Array
    """Contact points (B, 3), body frame, m; (3,) for one frame."""
    force: Array
    """Normal forces (B,), N."""
    headings: Array | None = None
    """Rotations of the body (B, 3, 3), world from body; an unknown indenter offset needs them."""
    time: Array | None = None
    """Times (B,), s, rising; None: 50 frames a second."""
    errors: Array | None = None
    """Known errors (B, 3) of points and forces, as `Calibration.contact_errors`; None: none."""

    def __post_init__(self) -> None:
        points = np.atleast_2d(check_array("contact points", self.points, error=RecordingError))
        points = check_vectors("contact points", points.reshape(-1, 3), error=RecordingError)
        force = np.atleast_1d(check_array("contact forces", self.force, error=RecordingError))
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "force", np.broadcast_to(force, len(points)))
        for name, shape in (
            ("headings", (len(points), 3, 3)),
            ("time", (len(points),)),
            ("errors", (len(points), 3)),
        ):
            if (value := getattr(self, name)) is not None:
                value = np.asarray(value, dtype=float).reshape(-1, *shape[1:])
                if value.shape != shape:
                    raise RecordingError(
                        f"{name} of contact frames", value=f"shape {value.shape}", limit=str(shape)
                    )
                object.__setattr__(self, name, value)

    def __len__(self) -> int:
        return len(self.points)

    def take(self, rows: slice | np.ndarray) -> ContactFrames:
        """The frames `rows`: a slice, a mask or indices."""
        others = (
            None if values is None else values[rows]
            for values in (self.headings, self.time, self.errors)
        )
        return ContactFrames(self.points[rows], self.force[rows], *others)


def sparse(readings: Array, threshold: float) -> tuple[np.ndarray, np.ndarray, Array]:
    """Frame, taxel and pressure (k,) of the readings (B, n) that say more than that a taxel is
    silent: those above `threshold`, Pa, and, as NaN, those that are lost or negative.
    """
    with np.errstate(invalid="ignore"):
        lost, heard = ~(readings >= 0), readings > threshold
    frame, taxel = np.nonzero(lost | heard)
    return frame, taxel, np.where(lost, np.nan, readings)[frame, taxel]
