"""The live page: a viser server with the 3D view and the panel of one recording."""

from __future__ import annotations

import contextlib
import io
import socket
from threading import Lock
from typing import Any

from ...core.errors import ConfigError
from ...estimation.calibration import Calibration
from .drawing import Drawing
from .panel import Panel
from .replay import Snapshot
from .stage import Stage


class LivePage(contextlib.AbstractContextManager["LivePage"]):
    """A page in the browser that shows snapshots of one stage."""

    def __init__(self, stage: Stage, host: str, port: int, speed: float) -> None:
        """Serve the page at http://host:port; port 0: any free one.

        Raises ConfigError without viser, or where the port cannot be used.
        """
        viser = import_viser()
        check_port(host, port)
        with _silent():
            self.server = viser.ViserServer(host=host, port=port, verbose=False)
        self.server.gui.configure_theme(
            control_width="large", show_logo=False, show_share_button=False
        )
        self.server.gui.main_panel.dock_right()
        self.server.gui.set_panel_label("meshskin")
        self.drawing = Drawing(self.server.scene, stage)
        self.panel = Panel(self.server.gui, stage, self.drawing, speed)
        self._lock = Lock()
        self.panel.view.on_update(lambda _: self._turn())
        self.panel.magnified.on_update(lambda _: self._magnify())
        self._last: Snapshot | None = None
        self._set_camera(self.server.initial_camera)

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def address(self) -> str:
        """The page's address."""
        return f"http://{self.server.get_host()}:{self.server.get_port()}"

    @property
    def viewers(self) -> int:
        """Number of browsers that show the page."""
        return len(self.server.get_clients())

    def show(self, snapshot: Snapshot) -> None:
        """Bring the page to a snapshot."""
        with self._lock, self.server.atomic():
            self._last = snapshot
            self.drawing.show(snapshot)
            self.panel.show(snapshot)

    def conclude(self, found: Calibration) -> None:
        """Show the calibration of all contacts in place of what was estimated on the way."""
        if self._last is None:
            return
        with self._lock, self.server.atomic():
            self._last = self._last.concluded(found)
            self.drawing.show(self._last)
            self.panel.conclude(found)

    def close(self) -> None:
        """Stop the server; browsers wait for it to come back."""
        with _silent():
            self.server.stop()

    def _turn(self) -> None:
        """Take the view that the panel names."""
        with self._lock, self.server.atomic():
            self.drawing.view = self.panel.view.value
            self.drawing.place(self.panel.row)
            self._set_camera(self.server.initial_camera)
            for client in self.server.get_clients().values():
                self._set_camera(client.camera)

    def _magnify(self) -> None:
        """Draw the ellipsoids at the size that the panel names."""
        with self._lock, self.server.atomic():
            self.drawing.magnified = float(self.panel.magnified.value)
            if self._last is not None:
                self.drawing.show(self._last)

    def _set_camera(self, camera: Any) -> None:
        position, target, up = self.drawing.camera(self.panel.row)
        self.drawing.light_from(position - target)
        if camera is self.server.initial_camera:
            camera.up = up
        else:  # what equals the browser's last report is not sent, and it may have taken the first
            camera.up_direction = up + position - target  # camera since; so another one comes first
            camera.up_direction = up
        camera.position, camera.look_at = position, target


def import_viser() -> Any:
    """The module viser. Raises ConfigError without it."""
    try:
        import viser
    except ImportError as error:
        raise ConfigError(
            "the live page needs viser", remedy='pip install "meshskin[live]"'
        ) from error
    return viser


def _silent() -> contextlib.redirect_stdout[io.StringIO]:
    """viser reports its start and its stop on stdout."""
    return contextlib.redirect_stdout(io.StringIO())


def check_port(host: str, port: int) -> None:
    """Raise ConfigError unless a server can listen at host and port.

    viser would take the next free port, and wait for ever for a host that is not this machine.
    """
    try:
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, port))
    except (OSError, OverflowError) as error:
        raise ConfigError(
            "the live page cannot be served",
            value=f"{host}:{port} ({error})",
            remedy="choose another --port, or --port 0 for any free one",
        ) from error
