"""An online calibration frame by frame, beside calibrating all contacts so far again.

    python studies/speed/online.py [--taxels N] [--contacts M] [--out DIR]

Contacts come one by one, lane after lane over the skin of studies/speed/joint.py, 11 for each
taxel, or the first M of them. The time of a frame is that of `update` with all it tells, in
processor time on one thread; beside it stands `ms.calibrate` of the same contacts. Distances from
the batch estimate are in its standard deviations, right after the last contact and after `settle`.
Exits with 1 where one frame of a hundred takes more than 20 ms, or an estimate is further than 1 %
of a standard deviation from the batch estimate.
"""

from __future__ import annotations

import argparse
import resource
import sys
from time import process_time

import numpy as np
import results
from joint import SPACING, world

import meshskin as ms
from meshskin.core.blas import single_threaded

FRAME_LIMIT = 0.020
"""Processor seconds of a frame, at 50 frames a second."""
DISTANCE_LIMIT = 0.01
"""Distance from the batch estimate, in standard deviations."""


@single_threaded()
def measure(taxels: int, contacts: int | None) -> tuple[dict[str, float], str]:
    """Numbers of one size, for the first `contacts`, or all."""
    recording, belief, truth = world(taxels)
    dense = np.zeros((len(recording.time), taxels))
    dense[recording.reading_contact, recording.reading_taxel] = recording.pressure
    order = lanes(recording.points)[:contacts]
    online = ms.OnlineCalibration(belief)
    memory, seconds = peak_memory(), np.empty(len(order))
    for k, row in enumerate(order):
        contact = ms.ContactFrames(recording.points[row], recording.force[row])
        begin = process_time()
        online.update(contact, dense[row])
        seconds[k] = process_time() - begin
    grown = peak_memory() - memory
    begin = process_time()
    batch = ms.calibrate(online.recording(), belief)
    batch_seconds = process_time() - begin
    before, missing = distances(online, batch)
    begin = process_time()
    status = online.settle()
    settle_seconds = process_time() - begin
    after, lost = distances(online, batch)
    error = np.linalg.norm(online.positions - truth, axis=1)
    numbers = {
        "taxels": taxels,
        "contacts": len(order),
        "frame_ms_mean": 1e3 * seconds.mean(),
        "frame_ms_p99": 1e3 * float(np.quantile(seconds, 0.99)),
        "frame_ms_largest": 1e3 * seconds.max(),
        "frame_ms_last_tenth": 1e3 * seconds[-len(seconds) // 10 :].mean(),
        "frames_per_second": 1 / seconds.mean(),
        "batch_seconds": batch_seconds,
        "settle_seconds": settle_seconds,
        "memory_mb": grown,
        "distance": before,
        "not_yet_determined": missing,
        "distance_settled": after,
        "not_determined": lost,
        "sigma_ratio": float(np.nanmax(online.position_sigma / batch.position_sigma)),
        "error_mm": 1e3 * float(np.nanmean(error)),
        "batch_error_mm": 1e3 * float(
            np.nanmean(np.linalg.norm(batch.positions - truth, axis=1))
        ),
    }  # fmt: skip
    return numbers, str(status)


def lanes(points: np.ndarray) -> np.ndarray:
    """Rows of the contact points (m, 3) in the order of lanes to and fro, SPACING apart."""
    lane = np.round(points[:, 0] / SPACING).astype(int)
    along = np.where(lane % 2, -points[:, 1], points[:, 1])
    return np.lexsort((along, lane))


def distances(online: ms.OnlineCalibration, batch: ms.Calibration) -> tuple[float, int]:
    """The largest distance from the batch estimate, in its standard deviations, and the number of
    taxels that only the batch estimate determines."""
    gap = np.linalg.norm(online.positions - batch.positions, axis=1) / batch.position_sigma
    missing = np.isfinite(batch.positions[:, 0]) & ~np.isfinite(online.positions[:, 0])
    return float(np.nanmax(gap)), int(missing.sum())


def peak_memory() -> float:
    """Largest memory of this process so far, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main() -> None:
    """Print the numbers, and write them where asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--taxels", type=int, default=1000)
    parser.add_argument("--contacts", type=int, help="the first so many; by default all")
    results.add_out(parser)
    options = parser.parse_args()
    numbers, status = measure(options.taxels, options.contacts)
    print(status)
    for name, value in numbers.items():
        print(f"{name:20s} {value:.4g}")
    kinds = {"mean": "mean", "p99": "99 of 100", "largest": "largest", "last_tenth": "last tenth"}
    rows = {words: {"frame": numbers[f"frame_ms_{kind}"]} for kind, words in kinds.items()}
    limits = {"50 frames a second": 1e3 * FRAME_LIMIT}
    results.write(options.out, "online", numbers, rows, "processor time (ms)", limits)
    slow = numbers["frame_ms_p99"] > 1e3 * FRAME_LIMIT
    far = max(numbers["distance"], numbers["distance_settled"]) > DISTANCE_LIMIT
    if slow or far:
        sys.exit(1)


if __name__ == "__main__":
    main()
