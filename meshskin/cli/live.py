"""`meshskin live LOG`: show a recording in the browser while it is calibrated online.

LOG and what is known of the robot are given as to `meshskin calibrate`; nothing is written. The
replay begins when a browser shows the page, and the command ends when the replay is over and the
page is closed. Where the noise of the readings is not known (--noise-kpa, or that of --scene), it
is estimated on the way.

Contacts that follow from joint angles, and the response of raw readings (--raw), are learned first,
from the whole log as `meshskin calibrate` does; the replay then estimates the taxels anew, with
these as known. At the end the page shows the calibration of all contacts together.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
import webbrowser
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.arguments import check_real
from ..core.errors import MeshskinError
from . import belief_options, log_options
from .calibrate import recorded
from .log_options import FromLog, from_log
from .options import integer, option, real
from .progress_bar import bar

if TYPE_CHECKING:
    from ..estimation.calibration import Calibration
    from ..estimation.online.known_response import KnownResponse
    from ..estimation.online.online_calibration import OnlineCalibration
    from ..recording.recording import Recording
    from ..report.live.page import LivePage
    from ..report.live.stage import Stage
    from ..scene.belief import Belief
    from ..scene.scene import Scene

HOST, PORT = "127.0.0.1", 8080
"""Where the page is served by default: to this machine alone, as it asks for no password; the port
is viser's own default."""
PAGE = {"speed": 1.0, "target_mm": 0.1, "host": HOST, "port": PORT, "no_browser": False}
"""Options of the page, with their defaults."""
AWAY = 5.0
"""Time without a browser, s, after which the page counts as closed; a reload takes less."""
LOOK = 0.2
"""Time between two looks for a browser, s."""


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    option(parser, "recording LOG", "recorded log, see above", Path)
    add_page(parser.add_argument_group("the page"))
    belief_options.add(parser)
    log_options.add(parser)
    parser.set_defaults(method="joint", export=None)  # which the options above look at


def add_page(group: argparse._ArgumentGroup) -> None:
    """Add the options of the page."""
    positive = real(above=0.0)
    option(group, "--speed X", "speed relative to real time (default 1)", positive)
    option(
        group, "--target-mm MM", "standard deviation of a taxel's position at which the verdict is "
        '"done" (default 0.1)', positive,
    )  # fmt: skip
    option(
        group, "--host HOST", f"address that the page is served at (default {HOST}: to this "
        "machine only; there is no password)",
    )  # fmt: skip
    option(group, "--port PORT", f"port (default {PORT}; 0: any free one)", integer(0))
    option(group, "--no-browser", "open no browser")


def command(options: argparse.Namespace) -> int:
    """Show the recording, and at the end the calibration of all of it."""
    with LiveView(options) as view:
        with bar(quiet=False) as progress:
            given = recorded(options) if options.map is None else from_log(options, progress)
        found = given.found or (_calibrated(given) if _has_own_response(given) else None)
        known = _known_response(found, given.recording)
        for line in given.lines:
            print(line)
        view.play(_stage(given, options, known), known)
        over = "the replay is over; nothing was written"
        try:
            view.conclude(found or _calibrated(given))
        except MeshskinError as error:
            print(f"live page: no calibration of all contacts: {error}", flush=True)
            over = f"no calibration of all contacts: {error}; {over}"
        view.finish(over)
    return 0


def _has_own_response(given: FromLog) -> bool:
    """Whether the response is one that only a calibration of all contacts learns: declared so, or
    of contacts for which no contact model holds."""
    from ..contact import AUTO, LEARNED
    from ..estimation.data.gather import holds
    from ..scene.belief import RAW

    belief = given.belief
    if belief.readings == RAW or belief.contact == LEARNED:
        return True
    return belief.contact == AUTO and not holds(given.recording, belief)


def _calibrated(given: FromLog) -> Calibration:
    """The calibration of all contacts together."""
    from ..estimation.calibrate import calibrate

    with bar(quiet=False) as progress:
        return calibrate(given.recording, given.belief, progress=progress)


def _known_response(found: Calibration | None, recording: Recording) -> KnownResponse | None:
    """The response that a calibration of the whole log learned, if it did."""
    from ..estimation.online.known_response import KnownResponse

    if found is None or found.response is None:
        return None
    known = KnownResponse.of(found, recording)
    print(f"live page: the response is as learned from the whole log ({found.verdict})")
    if found.additions is not None:
        print("live page: readings are shown without what their past, neighbours and drifts add")
    return known


def _stage(given: FromLog, options: argparse.Namespace, known: KnownResponse | None) -> Stage:
    """What is shown: with the robot of --scene, or of joint angles, which are then those of a
    calibration of the whole log.
    """
    from ..report.live.stage import Stage
    from ..scene.scene import Scene

    recording, belief = given.recording, given.belief
    if given.found is not None and given.found.belief is not None:
        belief = given.found.belief
    if known is not None:
        recording, belief = known.recording, known.belief
    if given.robot is not None and given.log is not None:
        return Stage.of_log(recording, belief, given.robot, options.link, given.log)
    if options.scene is not None:
        return Stage.of_scene(recording, Scene.load(options.scene), belief)
    return Stage.of_recording(recording, belief)


class LiveView(AbstractContextManager["LiveView"]):
    """The page of a command, from when there is something to show until it is closed."""

    def __init__(self, options: argparse.Namespace) -> None:
        """Raises ConfigError without viser, for a port that is not free or a bad speed."""
        from ..report.live.page import check_port, import_viser
        from ..report.live.panel import SPEEDS

        given = {k: v for k in PAGE if (v := getattr(options, k)) is not None}
        self.options = options = argparse.Namespace(**vars(options) | PAGE | given)
        import_viser()
        check_port(options.host, options.port)
        check_real("--speed", options.speed, least=SPEEDS[0], most=SPEEDS[1])
        self.page: LivePage | None = None

    def __exit__(self, *_: object) -> None:
        if self.page is not None:
            self.page.close()

    def play(self, stage: Stage, known: KnownResponse | None = None) -> None:
        """Open the page, and show the recording while it is calibrated online; with a learned
        response where it is known."""
        from ..report.live.page import LivePage
        from ..report.live.replay import replay

        online = self._online(stage, known)
        self.page = page = LivePage(stage, self.options.host, self.options.port, self.options.speed)
        print(f"live page: {page.address} (the replay begins when a browser shows it)", flush=True)
        self._open(page.address)
        while not page.viewers:
            time.sleep(LOOK)
        errors = None if known is None else known.errors
        for snapshot in replay(stage.recording, online, page.panel, errors=errors):
            page.show(snapshot)
        print(f"live page: {online.status}", flush=True)
        page.panel.finish("the calibration of all contacts together follows")

    def watch(self, scene: Scene, recording: Recording, found: Calibration) -> None:
        """Show the recording of a scene, as `pipeline.run` calls it."""
        from ..report.live.stage import Stage

        belief = scene.belief() if found.belief is None else found.belief
        self.play(Stage.of_scene(recording, scene, belief))
        self.conclude(found)

    def conclude(self, found: Calibration) -> None:
        """Show the calibration of all contacts, and say what it is."""
        if self.page is not None:
            self.page.conclude(found)
        print(f"live page: all contacts together: {found!r}, {found.verdict}", flush=True)

    def finish(self, words: str) -> None:
        """Say how it ended, and wait until the page is closed."""
        if self.page is None:
            return
        self.page.panel.finish(words)
        print("live page: close it to end", flush=True)
        away = 0.0
        while away < AWAY:
            time.sleep(LOOK)
            away = 0.0 if self.page.viewers else away + LOOK

    def _online(self, stage: Stage, known: KnownResponse | None) -> OnlineCalibration:
        """The online calibration of a stage. Raises CalibrationError."""
        from ..estimation.online.online_calibration import OnlineCalibration

        target = 1e-3 * self.options.target_mm
        left_out = [int(k) for k in stage.recording.metadata.get("unreachable", ())]
        if known is not None:
            return known.online(target, left_out)
        belief = _estimable(stage.belief)
        return OnlineCalibration(belief, target_sigma=target, unreachable=left_out)

    def _open(self, address: str) -> None:
        """Open a browser, unless there is none or none is wanted."""
        if self.options.no_browser:
            return
        if not _has_display() or not webbrowser.open(address):
            print("meshskin: no browser could be opened; open the page yourself", file=sys.stderr)


def _estimable(belief: Belief) -> Belief:
    """The belief without what an online calibration does not estimate; says so."""
    if belief.module_slots is not None:
        print("live page: rigid modules are not estimated online: their taxels are, one by one")
    if belief.contact_motion is not None:
        print("live page: unknowns of the robot are not estimated online: they are as calibrated")
    return replace(belief, module_slots=None, contact_motion=None)


def _has_display() -> bool:
    """Whether a browser would have a window; without one a text browser would take the terminal."""
    return sys.platform in ("win32", "darwin") or bool(
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    )
