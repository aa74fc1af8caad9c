"""Reading a large bag: processor time and peak memory of each format, and of what follows.

    OMP_NUM_THREADS=1 python studies/speed/log.py [--small] [--out DIR]

A log is made in a temporary folder: joint states (7 joints) at 200 Hz, 1,000 taxels (float32) at
100 Hz, wrenches at 500 Hz, and images at 1 Hz, which no map names: 20 minutes for 1 GB (--small:
50 MB). For each format, in a process of its own: `read_log` with a map of the three topics,
`read_log` without a map (the list of `meshskin log`), and `log_frames`, which tares and finds the
clock offset. Times are processor times; the memory is the peak of the process less that after its
imports.

The exit code is 1 if a target is missed: 60 s for the mapped topics of 1 GB, and at most 4 times
their arrays in memory.
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time
from typing import Any

import numpy as np
import results

JOINTS, TAXELS, IMAGE = 7, 1_000, 480 * 640
RATES = {"/joint_states": 200, "/skin": 100, "/wrench": 500, "/camera": 1}
"""Messages a second."""
BYTES = sum(
    RATES[topic] * size
    for topic, size in {"/joint_states": 260, "/skin": 4 * TAXELS, "/wrench": 100}.items()
)
"""Bytes a second of the mapped topics, about."""
SIZE, SMALL = 1e9, 5e7
LIMIT_S, LIMIT_MEMORY = 60.0, 4.0
FORMATS = ("ros1.bag", "ros2_sqlite", "ros2_mcap")
PERIOD = 1.5
"""Seconds from one press to the next."""


def stroke(time: np.ndarray) -> np.ndarray:
    """Force of the presses, N, at the times, s."""
    return 3.0 * np.maximum(np.sin(2 * np.pi * time / PERIOD), 0.0) ** 1.5


def messages(store: Any, seconds: float) -> Iterator[tuple[int, str, str, Any]]:
    """Time, ns, topic, type and message of a log, by time."""
    types, rng = store.types, np.random.default_rng(1)
    vector, empty = types["geometry_msgs/msg/Vector3"], np.empty(0)
    layout = types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    names = [f"joint_{k}" for k in range(JOINTS)]
    image = rng.integers(0, 255, IMAGE, dtype=np.uint8)
    extra = {"seq": 0} if "seq" in str(store.fielddefs["std_msgs/msg/Header"]) else {}

    def header(ns: int) -> Any:
        stamp = types["builtin_interfaces/msg/Time"](sec=ns // 10**9, nanosec=ns % 10**9)
        return types["std_msgs/msg/Header"](stamp=stamp, frame_id="base", **extra)

    makers: dict[str, tuple[str, Callable[[int, float], dict[str, Any]]]] = {
        "/joint_states": (
            "sensor_msgs/msg/JointState",
            lambda ns, force: {
                "header": header(ns), "name": names, "velocity": empty, "effort": empty,
                "position": 0.3 + 0.01 * force * np.arange(1.0, JOINTS + 1),
            },
        ),
        "/skin": (
            "std_msgs/msg/Float32MultiArray",
            lambda ns, force: {
                "layout": layout,
                "data": (240 - 9 * force * (np.arange(TAXELS) < 20) + rng.normal(0, 1.5, TAXELS))
                .round().astype(np.float32),
            },
        ),
        "/wrench": (
            "geometry_msgs/msg/WrenchStamped",
            lambda ns, force: {
                "header": header(ns),
                "wrench": types["geometry_msgs/msg/Wrench"](
                    force=vector(x=0.0, y=0.0, z=float(force)), torque=vector(x=0.0, y=0.0, z=0.0)
                ),
            },
        ),
        "/camera": (
            "sensor_msgs/msg/Image",
            lambda ns, force: {
                "header": header(ns), "height": 480, "width": 640, "encoding": "mono8",
                "is_bigendian": 0, "step": 640, "data": image,
            },
        ),
    }  # fmt: skip
    times = {topic: np.arange(0, seconds, 1 / rate) for topic, rate in RATES.items()}
    every = sorted((round(1e9 * (t + 1e6)), topic) for topic, ts in times.items() for t in ts)
    for ns, topic in every:
        kind, make = makers[topic]
        yield ns, topic, kind, types[kind](**make(ns, float(stroke(np.array(1e-9 * ns)))))


def write(folder: Path, name: str, size: float) -> Path:
    """A bag of about `size` bytes."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    first = name.endswith(".bag")
    store = get_typestore(Stores.ROS1_NOETIC if first else Stores.ROS2_HUMBLE)
    plugin = StoragePlugin.MCAP if "mcap" in name else StoragePlugin.SQLITE3
    path = folder / name
    writer: Any = Writer1(path) if first else Writer2(path, version=9, storage_plugin=plugin)
    known: dict[str, Any] = {}
    with writer:
        for ns, topic, kind, message in messages(store, size / (BYTES + RATES["/camera"] * IMAGE)):
            if topic not in known:
                known[topic] = writer.add_connection(topic, kind, typestore=store)
            encode = store.serialize_ros1 if first else store.serialize_cdr
            writer.write(known[topic], ns, encode(message, kind))
    return path


def peak() -> float:
    """Largest memory of this process so far, MB (Linux; its ru_maxrss would count the parent's)."""
    status = Path("/proc/self/status").read_text(encoding="utf-8")
    return 1.024e-3 * float(status.partition("VmHWM:")[2].split()[0])


def measure(path: str, what: str, queue: Any) -> None:
    """Processor time (s), memory (MB) and size of the arrays (MB) of one step."""
    from meshskin.recording.log_map import LogMap, StreamMap
    from meshskin.recording.readers import read_log
    from meshskin.recording.readers.bag import read
    from meshskin.recording.resample import log_frames

    read.require_rosbags(Path(path))
    log_map = LogMap(
        (
            StreamMap("/joint_states", "joints"),
            StreamMap("/wrench", "wrench"),
            StreamMap("/skin", "taxels", length=TAXELS),
        )
    )
    before, clock = peak(), process_time()
    log = read_log(path, None if what == "list" else log_map)
    if what == "frames":
        clock = process_time()
        log_frames(log, log_map)
    seconds = process_time() - clock
    arrays = sum(stream.values.nbytes + stream.times.nbytes for stream in log.streams) / 1e6
    queue.put({"seconds": seconds, "memory_mb": peak() - before, "arrays_mb": arrays})


def alone(path: Path, what: str) -> dict[str, Any]:
    """`measure` in a process that does nothing else."""
    context = multiprocessing.get_context("spawn")
    queue = context.Queue()
    process = context.Process(target=measure, args=(str(path), what, queue))
    process.start()
    found: dict[str, Any] = queue.get()
    process.join()
    return found


def main() -> int:
    """Print one row for each format and step."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("--small", action="store_true", help="bags of 50 MB")
    results.add_out(parser)
    options = parser.parse_args()
    size = SMALL if options.small else SIZE
    rows, missed = [], []
    print(f"{'format':12} {'step':8} {'bag MB':>8} {'s':>8} {'memory MB':>10} {'arrays MB':>10}")
    for name in FORMATS:
        with TemporaryDirectory() as folder:
            path = write(Path(folder), name, size)
            files = [path] if path.is_file() else list(path.iterdir())
            megabytes = sum(file.stat().st_size for file in files) / 1e6
            for what in ("read", "list", "frames"):
                row: dict[str, Any] = {
                    "format": name,
                    "step": what,
                    "bag_mb": megabytes,
                    **alone(path, what),
                }
                rows.append(row)
                print(
                    f"{name:12} {what:8} {megabytes:8.0f} {row['seconds']:8.2f} "
                    f"{row['memory_mb']:10.0f} {row['arrays_mb']:10.0f}", flush=True,
                )  # fmt: skip
                slow = what == "read" and row["seconds"] > LIMIT_S * megabytes / 1000
                if slow or row["memory_mb"] > LIMIT_MEMORY * max(row["arrays_mb"], 100):
                    missed.append(f"{name} {what}")
    shown: dict[str, dict[str, float]] = {}
    for row in rows:
        shown.setdefault(row["step"], {})[row["format"]] = row["seconds"]
    results.write(options.out, "log", rows, shown, "processor time (s)")
    print(f"missed: {', '.join(missed)}" if missed else "all targets met")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
