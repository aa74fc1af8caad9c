"""A robot that presses its skin at several places and retracts, and the bags of its log.

The readings are those of a taxel whose pressure falls with the distance from the contact and rises
with its depth: closed forms, so that what a reader or an estimate finds can be compared.
"""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

EPOCH = 1_700_000_000.0
"""Time of the first sample, s: the clock of a computer."""
JOINTS = ("shoulder", "elbow", "wrist")
SIDE, PITCH = 5, 5e-3
"""Taxels on a side of the patch, and their distance, m."""


@dataclass(frozen=True)
class RobotLog:
    """Joint angles at 125 Hz, forces at 200 Hz, counts of 25 taxels at 50 Hz."""

    contacts: int = 12
    period: float = 1.6
    late: float = 0.037
    """How late the stamps of the skin are, s."""
    noise: float = 1.5
    """Counts."""
    drift: float = 4.0
    """Counts over the log."""
    rest: float = 240.0
    gain: float = -9.0
    """Counts per N at the centre of a contact: raw counts fall under pressure."""
    seed: int = 1
    rng: np.random.Generator = field(init=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "rng", np.random.default_rng(self.seed))
        sites = self.rng.uniform(0, (SIDE - 1) * PITCH, (self.contacts, 2))
        object.__setattr__(self, "sites", sites)
        starts = (
            1.0 + self.period * np.arange(self.contacts) + self.rng.uniform(0, 0.1, self.contacts)
        )
        object.__setattr__(self, "starts", starts)

    @property
    def duration(self) -> float:
        return 2.0 + self.period * self.contacts

    def stroke(self, time):
        """Depth of the indenter (n,), m, negative before contact, and the site (n,)."""
        site = np.clip(np.searchsorted(self.starts, time) - 1, 0, self.contacts - 1)
        phase = np.clip((time - self.starts[site]) / (self.period - 0.2), 0, 1)
        return -2e-3 + 4e-3 * np.sin(np.pi * phase) ** 2 * (phase < 1), site

    def force_at(self, time):
        """Contact force (n,), N."""
        depth, _ = self.stroke(time)
        return 3.0 * np.maximum(depth / 2e-3, 0.0) ** 1.5

    def joints_at(self, time):
        """Joint angles (n, 3), rad: the stroke moves all of them, the site the first two."""
        depth, site = self.stroke(time)
        return np.stack(
            [
                0.3 + 8 * self.sites[site, 0] + 10 * depth,
                0.6 + 8 * self.sites[site, 1] - 20 * depth,
                -0.2 + 30 * depth,
            ],
            axis=1,
        )

    def counts_at(self, time):
        """Noiseless counts (n, 25) at rest and under pressure, without drift."""
        _, site = self.stroke(time)
        x, y = np.meshgrid(PITCH * np.arange(SIDE), PITCH * np.arange(SIDE), indexing="ij")
        taxels = np.stack([x.ravel(), y.ravel()], axis=1)
        distance = np.linalg.norm(self.sites[site][:, None] - taxels, axis=2)
        shape = np.exp(-0.5 * (distance / 4e-3) ** 2)
        return self.rest + self.gain * self.force_at(time)[:, None] * shape

    def streams(self):
        """Times since EPOCH on each one's clock, and values, by topic."""
        joints = np.arange(0, self.duration, 1 / 125)
        force = np.arange(0, self.duration, 1 / 200)
        skin = np.arange(0.004, self.duration, 1 / 50)
        counts = self.counts_at(skin) + self.drift * skin[:, None] / self.duration
        counts += self.rng.normal(0, self.noise, counts.shape)
        wrench = np.zeros((len(force), 6))
        wrench[:, :3] = [0.4, -0.2, 5.0]
        wrench[:, 2] += self.force_at(force)
        wrench += self.rng.normal(0, 0.02, wrench.shape)
        return {
            "/joint_states": (joints, self.joints_at(joints)),
            "/wrench": (force, wrench),
            "/skin": (skin + self.late, np.round(counts).astype(np.float32)),
        }


def stamp(store, time):
    ns = round((EPOCH + time) * 1e9)
    return store.types["builtin_interfaces/msg/Time"](sec=ns // 10**9, nanosec=ns % 10**9), ns


def header(store, time):
    when, _ = stamp(store, time)
    extra = {"seq": 0} if "seq" in str(store.fielddefs["std_msgs/msg/Header"]) else {}
    return store.types["std_msgs/msg/Header"](stamp=when, frame_id="base", **extra)


def messages(store, streams):
    """Topic, type, message and time of receipt, ns, of the streams, by time."""
    t = store.types
    vector = t["geometry_msgs/msg/Vector3"]
    layout = t["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    out = []
    for topic, (times, values) in streams.items():
        for time, row in zip(times, values, strict=True):
            if topic == "/joint_states":
                kind = "sensor_msgs/msg/JointState"
                empty = np.empty(0)
                message = t[kind](
                    header=header(store, time), name=list(JOINTS), position=np.array(row, float),
                    velocity=empty, effort=empty,
                )  # fmt: skip
            elif topic == "/wrench":
                kind = "geometry_msgs/msg/WrenchStamped"
                wrench = t["geometry_msgs/msg/Wrench"](
                    force=vector(*map(float, row[:3])), torque=vector(*map(float, row[3:]))
                )
                message = t[kind](header=header(store, time), wrench=wrench)
            else:
                kind = "std_msgs/msg/Float32MultiArray"
                message = t[kind](layout=layout, data=np.array(row, np.float32))
            out.append((stamp(store, time)[1], topic, kind, message))
    out.sort(key=lambda one: one[0])
    return out


def write_ros1(path: Path, streams, compression=None):
    store = get_typestore(Stores.ROS1_NOETIC)
    writer = Writer1(path)
    if compression is not None:
        writer.set_compression(compression)
    with writer:
        known = {}
        for time, topic, kind, message in messages(store, streams):
            if topic not in known:
                known[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(known[topic], time, store.serialize_ros1(message, kind))


def write_ros2(folder: Path, streams, plugin=StoragePlugin.SQLITE3):
    store = get_typestore(Stores.ROS2_HUMBLE)
    with Writer2(folder, version=9, storage_plugin=plugin) as writer:
        known = {}
        for time, topic, kind, message in messages(store, streams):
            if topic not in known:
                known[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(known[topic], time, store.serialize_cdr(message, kind))


def write_mcap(path: Path, streams, **options):
    """Written by the library mcap, with definitions of rosbags."""
    from mcap.writer import Writer

    store = get_typestore(Stores.ROS2_HUMBLE)
    with path.open("wb") as file:
        writer = Writer(file, **options)
        writer.start(profile="ros2", library="test")
        known = {}
        for time, topic, kind, message in messages(store, streams):
            if topic not in known:
                definition, _ = store.generate_msgdef(kind, ros_version=2)
                schema = writer.register_schema(kind, "ros2msg", definition.encode())
                known[topic] = writer.register_channel(topic, "cdr", schema)
            data = bytes(store.serialize_cdr(message, kind))
            writer.add_message(known[topic], log_time=time, data=data, publish_time=time)
        writer.finish()


def write_types(path: Path, topic: str, kind: str, definitions: dict, rows, stated=True):
    """An MCAP file by rosbags' types of user messages; rows: (time of receipt, make(types)). Not
    stated: without their definition, as a recorder writes it that does not find it."""
    from mcap.writer import Writer

    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in definitions.items():
        store.register(get_types_from_msg(text, name))
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2", library="test")
        definition, _ = store.generate_msgdef(kind, ros_version=2)
        given = ("ros2msg", definition.encode()) if stated else ("", b"")
        channel = writer.register_channel(topic, "cdr", writer.register_schema(kind, *given))
        if not stated:  # the recorder has found those of other topics
            other = "std_msgs/msg/String"
            definition, _ = store.generate_msgdef(other, ros_version=2)
            schema = writer.register_schema(other, "ros2msg", definition.encode())
            data = bytes(store.serialize_cdr(store.types[other](data=""), other))
            said = writer.register_channel("/said", "cdr", schema)
            writer.add_message(said, log_time=1, data=data, publish_time=1)
        for time, make in rows:
            _, ns = stamp(store, time)
            data = bytes(store.serialize_cdr(make(store), kind))
            writer.add_message(channel, log_time=ns, data=data, publish_time=ns)
        writer.finish()
