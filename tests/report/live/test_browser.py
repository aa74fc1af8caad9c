"""The live page in a headless Chromium: it draws, writes no errors, and comes back."""

import io
import time
from contextlib import ExitStack

import numpy as np
import pytest

from meshskin.report.live.page import LivePage

from .chromium import Chromium, executable

pytest.importorskip("viser", reason='no viser: pip install "meshskin[live]"')
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(executable() is None, reason="no Chromium on this machine"),
]
PATIENCE = 60.0
"""Time, s, in which a browser without a graphics card shows something."""


def wait_for(what, condition):
    """Wait until condition() holds; fails after PATIENCE."""
    end = time.monotonic() + PATIENCE
    while not (found := condition()):
        assert time.monotonic() < end, f"{what} after {PATIENCE} s"
        time.sleep(0.3)
    return found


def canvas(browser: Chromium) -> np.ndarray:
    """The page left of its panel (h, w, 3), 0 to 255."""
    from PIL import Image

    pixels = np.asarray(Image.open(io.BytesIO(browser.screenshot())).convert("RGB"))
    return pixels[:, : pixels.shape[1] // 2]


def drawn(browser: Chromium) -> bool:
    """Whether the canvas shows more than its background."""
    return len(np.unique(canvas(browser).reshape(-1, 3), axis=0)) > 200


def text(browser: Chromium) -> str:
    return browser.evaluate("document.body.innerText") or ""


def test_the_page_draws_and_comes_back_after_its_server_restarts(stage, snapshot):
    with ExitStack() as stack:
        browser = stack.enter_context(Chromium())
        with LivePage(stage, "127.0.0.1", 0, 1.0) as page:
            port = page.server.get_port()
            browser.open(page.address)
            wait_for("no viewer", lambda: page.viewers)
            page.show(snapshot)
            wait_for("no verdict", lambda: "keep going" in text(browser))
            wait_for("nothing drawn", lambda: drawn(browser))
            assert "78 determined" in text(browser)
            assert browser.errors == []
        with LivePage(stage, "127.0.0.1", port, 1.0) as page:
            wait_for("not back", lambda: page.viewers)
            page.show(snapshot)
            wait_for("nothing drawn", lambda: drawn(browser))
            page.panel.finish("this is the second server")
            wait_for("old words", lambda: "this is the second server" in text(browser))
        lost = "ERR_CONNECTION_REFUSED"
        assert [words for words in browser.errors if lost not in words] == []


def test_a_view_of_the_robot_is_another_picture(stage, snapshot):
    with Chromium() as browser, LivePage(stage, "127.0.0.1", 0, 1.0) as page:
        browser.open(page.address)
        wait_for("no viewer", lambda: page.viewers)
        page.show(snapshot)
        wait_for("nothing drawn", lambda: drawn(browser))
        before = canvas(browser)
        page.panel.view.value = "robot"
        wait_for("same view", lambda: np.mean(canvas(browser) != before) > 0.05)
        assert browser.errors == []


def test_a_view_that_is_taken_at_once_is_upright(stage, snapshot):
    """While the browser still takes the first camera, whose upward direction is another one."""
    with Chromium() as browser, LivePage(stage, "127.0.0.1", 0, 1.0) as page:
        browser.open(page.address)
        end = time.monotonic() + PATIENCE
        while not page.viewers:
            assert time.monotonic() < end
            time.sleep(0.005)
        page.panel.view.value = "robot"
        page.show(snapshot)
        wait_for("nothing drawn", lambda: drawn(browser))
        time.sleep(2.0)  # for what the browser reports of its camera
        (client,) = page.server.get_clients().values()
        _, _, up = page.drawing.camera(page.panel.row)
        w, x, y, z = client.camera.wxyz
        image_up = -np.array([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)])
        assert image_up @ up > 0.9
        np.testing.assert_allclose(client.camera.up_direction, up, atol=1e-3)
