"""`meshskin log FILE`: list the streams of a robot's log, and what each could be.

FILE is a ROS 1 bag, a ROS 2 bag (SQLite or MCAP, file or folder), a folder of the YARP data dumper,
or a CSV or Parquet file or a folder of them. --write-map writes a first map, to be edited: which
topic holds joint states, taxels, forces, poses or contacts. With --map the log is read by it: times
are compared, taxels tared, contacts found, and the clock of the skin compared with the robot's.
With --urdf its joints are compared with the robot's, whose links with meshes are named.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from . import body_options
from .options import option, refuse

if TYPE_CHECKING:
    from ..recording.log_map import LogMap, StreamMap
    from ..recording.resample import LogFrames
    from ..recording.stream import Log, Stream
    from ..robot.robot import Robot

SHOWN_GAPS = 3
"""Gaps of a stream that are listed."""


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    option(parser, "log FILE", "log, a file or a folder", Path)
    option(parser, "--map MAP", "map of the log (TOML)", Path)
    option(parser, "--write-map FILE", "write a first map, to be edited, to FILE", Path)
    messages = ".msg files of message types that the bag does not define"
    option(parser, "--messages MSG", messages, Path, nargs="*", default=[])
    add_scan(parser)
    urdf = "robot of the log, with whose joints those of the log are compared"
    option(parser, "--urdf FILE", urdf, Path)
    option(parser, "--link LINK", "link with the skin, whose joints and mesh are checked")
    body_options.add_folder(parser)
    option(
        parser, "--out RECORDING", "write contacts and readings as a recording; the map must name "
        "contact points and forces", Path,
    )  # fmt: skip


def add_scan(parser: argparse._ActionsContainer) -> None:
    """Add the option of bags without an index."""
    words = "read a ROS 1 bag that was never closed, and so has no index, record by record"
    option(parser, "--scan", words)


def command(options: argparse.Namespace) -> int:
    """Print the streams; write the map and the recording where asked for."""
    from ..core.atomic_io import check_writable, write_text
    from ..core.errors import ConfigError
    from ..recording.csv_log import NAMES
    from ..recording.log_map import LogMap
    from ..recording.readers import read_and_suggest
    from ..robot.robot import Robot

    if options.urdf is None:
        refuse(options, ("link", "folder"), "{} is for a URDF file", "give --urdf, too")
    if options.map is not None and options.write_map is not None:
        raise ConfigError("--map and --write-map are given together", remedy="remove one")
    if options.out is not None and options.map is None:
        raise ConfigError("--out needs --map", remedy="write a first map with --write-map")
    log_map = None if options.map is None else LogMap.load(options.map)
    if options.write_map is not None:
        check_writable(options.write_map)
    robot = None if options.urdf is None else Robot.from_urdf(options.urdf, options.folder)
    about = [] if robot is None else robot_lines(robot, options.link)
    log, could = read_and_suggest(
        options.log, log_map, messages=options.messages, progress=True, scan=options.scan
    )
    if log_map is not None:
        _convert(log, log_map, options.out, robot, about)
        return 0
    for line in (*listing(log, could), *about):
        print(line)
    if all((options.log / name).is_file() for name in NAMES):
        print(f"no map is needed: meshskin calibrate {options.log} reads {' and '.join(NAMES)}")
    if options.write_map is not None:
        write_text(options.write_map, first_map(log, could, options.messages).to_toml())
        print(f"map: {options.write_map}")
    if robot is not None:  # after the map, which its errors ask to correct
        _compare_joints(options, could, robot)
    for stream in log.streams:
        if stream.backward is not None:
            stream.check_times()
    return 0


def robot_lines(robot: Robot, link: str | None) -> list[str]:
    """The lines about a robot: its joints, its links with meshes, and the joints that move `link`.

    Raises UnknownNameError for a link that it does not have, MeshError for one without a mesh.
    """
    from ..geometry.mesh import link_mesh

    meshed = [e.get("name", "") for e in robot.tree.root.findall("link") if e.find("visual//mesh")
              is not None]  # fmt: skip
    lines = [
        f"  robot {robot.name}: joints {', '.join(robot.joint_names) or '-'}",
        f"  robot {robot.name}: links with meshes {', '.join(meshed) or '-'}",
    ]
    if link is not None:
        names = robot.chain(robot.root, link).joint_names
        link_mesh.in_tree(robot.tree.root, robot.path, link, robot.folders, "visual")
        lines.append(f"  {link} is moved by {', '.join(names) or 'no joint'}")
    return lines


def _compare_joints(
    options: argparse.Namespace, could: dict[str, list[StreamMap]], robot: Robot
) -> None:
    """Print the joints of the streams that could be joints beside those of the robot."""
    from ..recording.joint_check import check_joints
    from ..recording.log_map import LogMap
    from ..recording.readers import read_log
    from ..recording.stream import JOINTS

    maps = [found[0] for found in could.values() if found and found[0].kind == JOINTS]
    if not maps:
        print("  no stream of the log could be joints")
        return
    messages = tuple(options.messages)
    log = read_log(options.log, LogMap(tuple(maps), messages), progress=True, scan=options.scan)
    for line in check_joints(list(zip(log.streams, maps, strict=True)), robot):
        print(f"  {line}")


def _convert(
    log: Log, log_map: LogMap, out: Path | None, robot: Robot | None, about: list[str]
) -> None:
    """Bring the log to one clock, say what was found, and write a recording where asked for."""
    from ..recording.from_log import recording_from_log
    from ..recording.joint_check import check_joints
    from ..recording.resample import log_frames, paired

    if robot is not None:
        about += [f"  {line}" for line in check_joints(paired(log, log_map), robot)]
    frames = log_frames(log, log_map, robot)
    recording = None if out is None else recording_from_log(log, log_map, frames)
    for line in (*listing(log, {}), *about, *summary(frames, log)):
        print(line)
    if recording is not None and out is not None:
        recording.save(out)
        print(f"recording: {out}, {len(recording.time)} contacts, "
              f"{len(recording.pressure)} readings")  # fmt: skip


def listing(log: Log, could: dict[str, list[StreamMap]]) -> Iterator[str]:
    """The lines about the streams of a log: samples, rate, span, gaps, and what each could be."""
    import numpy as np

    spans = np.array([stream.span for stream in log.streams if len(stream)]).reshape(-1, 2)
    start = float(spans[:, 0].min()) if len(spans) else 0.0
    wide = max([6, *(len(stream.name) for stream in log.streams)])
    count = f"{len(log.streams)} stream{'s' * (len(log.streams) != 1)}"
    yield f"{log.path.name}: {count}, times from {start:.6f} s"
    for note in log.notes:
        yield f"  note: {note}"
    header = f"{'samples':>8} {'rate Hz':>8} {'from s':>9} {'to s':>9} {'gaps':>5}"
    yield f"  {'stream':{wide}} {header}  is"
    for stream in log.streams:
        first, last = (value - start for value in stream.span)
        kinds = stream.kind or ", ".join(_words(one) for one in could.get(stream.name, [])[:3])
        yield (
            f"  {stream.name:{wide}} {len(stream):8} {stream.rate:8.4g} {first:9.3f} {last:9.3f} "
            f"{len(stream.gaps):5}  {kinds or '-'}{_of(stream)}"
        )
        for gap in stream.gaps[:SHOWN_GAPS]:
            yield f"  {'':{wide}}   gap of {gap.end - gap.start:.3g} s at {gap.start - start:.3f} s"


def _of(stream: Stream) -> str:
    """The type of a stream, in brackets, and the number of its values."""
    values = f"{len(stream.fields)} values, " if stream.kind else ""
    return f" ({values}{stream.type})" if values or stream.type else ""


def _words(one: StreamMap) -> str:
    """A possible kind, with where its numbers are if the type of the messages does not say it."""
    where = f" in {one.values[0]}" if len(one.values) == 1 else ""
    return f"{one.kind}{where}" + (f", {one.length}" if one.length else "")


def first_map(log: Log, could: dict[str, list[StreamMap]], messages: list[Path]) -> LogMap:
    """The likeliest kind of every stream, with ids of taxels that do not repeat; of several
    parts of a skin, the one with the most contacts.

    Raises ConfigError where no stream is recognized.
    """
    from dataclasses import replace

    from ..core.arguments import repr_short
    from ..core.errors import ConfigError
    from ..recording.log_map import LogMap

    streams, taxels = [], 0
    for name in sorted(could):
        for one in could[name][: None if name.endswith("tf") else 1]:
            if one.length and one.kind == "taxels":
                one = replace(one, first_id=taxels)
                taxels += one.length or 0
            streams.append(one)
    if not streams:
        raise ConfigError(
            "no stream of the log is recognized",
            value=repr_short(sorted(could)),
            remedy="see with meshskin log whether they have samples, or write the map by hand; a "
            "table needs a column for each joint and taxel",
        )
    return LogMap(_one_part(streams, log), tuple(messages))


def _one_part(streams: list[StreamMap], log: Log) -> tuple[StreamMap, ...]:
    """The streams with one part of a skin alone: contacts PART and taxels PART/taxels are in the
    frame of its link, and other parts number their taxels alike.
    """
    contacts = {stream.name: len(stream) for stream in log.streams}
    parts = [one.topic.removesuffix("/taxels") for one in streams if one.topic.endswith("/taxels")]
    parts = sorted((part for part in parts if part in contacts), key=contacts.__getitem__)
    other = {name for part in parts[:-1] for name in (part, f"{part}/taxels")}
    return tuple(one for one in streams if one.topic not in other)


def summary(frames: LogFrames, log: Log) -> Iterator[str]:
    """The lines about the log on one clock."""
    import numpy as np

    found = frames.skin_log
    for name, tared in frames.tared.items():
        live = tared.noise > 0
        silent = f", taxels that never change: {(~live).sum()}" if not live.all() else ""
        yield (
            f"  {name}: readings {'fall' if tared.falling else 'rise'} under pressure, noise "
            f"{tared.noise[live].mean():.3g}, drift {tared.drift[live].mean():.3g} "
            f"{log[name].unit}{silent}"
        )
    for offset in frames.offsets:
        used = " (applied)" if offset is frames.offsets[0] and offset.usable else ""
        yield f"  skin late by {offset}{used}"
    for note in frames.notes[len(log.notes) :]:
        yield f"  note: {note}"
    touched = int((found.readings[found.in_contact] > 6 * found.noise).any(axis=0).sum())
    touches = len(found.contacts)
    yield (
        f"  on one clock: {len(found.time)} frames, {len(found.joint_names)} joints, "
        f"{len(found.taxel_ids)} taxels of which {touched} answer, "
        f"{touches} touch{'es' * (touches != 1)} from onset to lift-off"
        + ("" if found.force is None else f", force up to {np.nanmax(found.force):.3g} N")
    )
