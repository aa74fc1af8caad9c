"""A headless Chromium, driven over its DevTools protocol, for tests of pages."""

import base64
import json
import shutil
import subprocess
import tempfile
import time
from pathlib import Path

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
"""Names of the program."""
FLAGS = (
    "--headless=new", "--no-sandbox", "--enable-unsafe-swiftshader", "--use-angle=swiftshader",
    "--disable-background-networking", "--disable-extensions", "--no-first-run",
    "--disable-component-update", "--remote-debugging-port=0", "--window-size=1440,900",
)  # fmt: skip
"""WebGL by software, and no traffic of the browser's own."""


def executable() -> str | None:
    """Path of the program; None where there is none."""
    return next(filter(None, map(shutil.which, NAMES)), None)


class Chromium:
    """One browser with one page; collects what the page writes to its console."""

    def __init__(self) -> None:
        from websockets.sync.client import connect

        self.folder = tempfile.mkdtemp()
        self.process = subprocess.Popen(
            [executable(), *FLAGS, f"--user-data-dir={self.folder}", "about:blank"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        port, path = self._endpoint()
        self.socket = connect(f"ws://127.0.0.1:{port}{path}", max_size=None)
        self.errors: list[str] = []
        """Errors of the console, and exceptions, in order."""
        self._count, self._session = 0, None
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        opened = self.call("Target.attachToTarget", targetId=target, flatten=True)
        self._session = opened["sessionId"]
        for domain in ("Runtime", "Log", "Page"):
            self.call(f"{domain}.enable")

    def __enter__(self):
        return self

    def __exit__(self, *_) -> None:
        self.socket.close()
        self.process.terminate()
        self.process.wait(20)
        shutil.rmtree(self.folder, ignore_errors=True)

    def _endpoint(self) -> list[str]:
        file = Path(self.folder) / "DevToolsActivePort"
        for _ in range(300):
            if file.exists() and len(lines := file.read_text().split()) == 2:
                return lines
            time.sleep(0.1)
        raise TimeoutError("Chromium does not start")

    def call(self, method: str, **parameters):
        """The result of a command of the protocol."""
        self._count += 1
        sent = {"id": self._count, "method": method, "params": parameters}
        if self._session is not None:
            sent["sessionId"] = self._session
        self.socket.send(json.dumps(sent))
        while True:
            answer = json.loads(self.socket.recv(60))
            if answer.get("id") == self._count:
                assert "error" not in answer, answer
                return answer["result"]
            self._note(answer)

    def _note(self, event) -> None:
        kind, details = event.get("method"), event.get("params", {})
        if kind == "Runtime.consoleAPICalled" and details["type"] in ("error", "assert"):
            words = [str(a.get("value", a.get("description"))) for a in details["args"]]
            self.errors.append(" ".join(words))
        elif kind == "Runtime.exceptionThrown":
            self.errors.append(str(details["exceptionDetails"]))
        elif kind == "Log.entryAdded" and details["entry"]["level"] == "error":
            self.errors.append(f"{details['entry']['text']} {details['entry'].get('url', '')}")

    def open(self, address: str) -> None:
        """Open a page."""
        self.call("Page.navigate", url=address)

    def evaluate(self, expression: str):
        """The value of a JavaScript expression."""
        return self.call("Runtime.evaluate", expression=expression, returnByValue=True)[
            "result"
        ].get("value")

    def screenshot(self) -> bytes:
        """The page as PNG."""
        return base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
