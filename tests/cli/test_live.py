"""`meshskin live` and `meshskin run --live`, without a browser."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest

import meshskin as ms
from meshskin.cli import live, main
from meshskin.report.live.page import LivePage
from meshskin.report.live.panel import Panel

pytest.importorskip("viser", reason='no viser: pip install "meshskin[live]"')


@pytest.fixture(scope="module")
def log(noisy, tmp_path_factory):
    """A short recording of the noisy sphere: two taxels, touched in their neighbourhood."""
    path = tmp_path_factory.mktemp("live") / "touches"
    rng = np.random.default_rng(0)
    near = noisy.skin.positions[:2].repeat(3, axis=0)
    ms.press(noisy, near + rng.normal(scale=1.5e-3, size=near.shape), seed=1).save(path)
    return str(path)


@pytest.fixture
def viewer(monkeypatch):
    """A browser that leaves when the replay is over; time passes at once."""
    shown = []
    show = LivePage.show

    def watch(self, snapshot):
        shown.append(snapshot)
        show(self, snapshot)

    monkeypatch.setattr(LivePage, "show", watch)
    monkeypatch.setattr(LivePage, "viewers", property(lambda self: int(not shown)))
    monkeypatch.setattr(live, "AWAY", 0.0)
    monkeypatch.setattr(live.webbrowser, "open", lambda address: True)
    return shown


def live_of(log: str, *options: str) -> int:
    return main(["live", log, "--scene", "sphere_noisy", "--port", "0", "--speed", "32", *options])


def test_a_recording_is_shown_to_its_end(log, viewer, monkeypatch, capsys):
    said = []
    monkeypatch.setattr(live, "_has_display", lambda: False)
    monkeypatch.setattr(Panel, "finish", lambda self, words: said.append(words))
    assert live_of(log) == 0
    assert viewer[-1].row == 5
    assert viewer[-1].status.used == 6
    assert said == ["the replay is over; nothing was written"]
    told = capsys.readouterr()
    assert "live page: http://127.0.0.1:" in told.out
    assert "6 contacts" in told.out
    assert told.err == "meshskin: no browser could be opened; open the page yourself\n"


def test_control_c_ends_as_elsewhere(log, viewer, monkeypatch, capsys):
    closed = []
    monkeypatch.setattr(LivePage, "close", lambda self: closed.append(self.server.stop()))

    def interrupt(self, snapshot):
        raise KeyboardInterrupt

    monkeypatch.setattr(LivePage, "show", interrupt)
    assert live_of(log, "--no-browser") == 130
    assert len(closed) == 1
    assert "interrupted" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["live", "x", "--speed", "0"], "--speed"),
        (["live", "x", "--port", "70000"], "cannot be served"),
        (["live", "no_such_log", "--port", "0", "--scene", "sphere"], "no recording"),
        (["run", "sphere", "--out", "o", "--live", "--seconds", "9"], "--live together"),
    ],
)
def test_bad_input_is_one_line(arguments, words, capsys):
    assert main(arguments) == 2
    err = capsys.readouterr().err
    assert words in err
    assert err.count("\n") == 1


@pytest.mark.parametrize("command", [["live", "x"], ["run", "sphere", "--out", "o", "--live"]])
def test_without_the_extra_the_pip_command_is_named(command, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "viser", None)
    assert main(command) == 2
    err = capsys.readouterr().err
    assert 'pip install "meshskin[live]"' in err
    assert err.count("\n") == 1


def test_a_run_is_shown_before_its_results(noisy, viewer, monkeypatch, tmp_path, capsys):
    recording = ms.press(noisy, noisy.skin.positions[:2], seed=1)
    found = SimpleNamespace(belief=None, fit=None)

    def run(*arguments, watch, **options):
        watch(noisy, recording, found)
        raise ms.core.errors.StudyError("this is all that is tested")

    monkeypatch.setattr("meshskin.pipeline.run", run)
    code = main(["run", "sphere_noisy", "--out", str(tmp_path), "--live", "--port", "0",
                 "--no-browser", "--speed", "32"])  # fmt: skip
    assert code == 2
    assert viewer[-1].status.used == 2
    assert "this is all" in capsys.readouterr().err
