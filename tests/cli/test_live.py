"""`meshskin live` and `meshskin run --live`, without a browser."""

import sys

import numpy as np
import pytest

import meshskin as ms
from meshskin.cli import live, main
from meshskin.core.errors import ContactError
from meshskin.report.live.page import LivePage
from meshskin.report.live.panel import Panel

pytest.importorskip("viser", reason='no viser: pip install "meshskin[live]"')


@pytest.fixture(scope="module")
def log(noisy, tmp_path_factory):
    """A short recording of the noisy sphere: two taxels, touched in their neighbourhood."""
    path = tmp_path_factory.mktemp("live") / "touches"
    touches(noisy, 3).save(path)
    return str(path)


def touches(noisy, count: int) -> ms.Recording:
    """So many contacts near each of two taxels."""
    rng = np.random.default_rng(0)
    near = noisy.skin.positions[:2].repeat(count, axis=0)
    return ms.press(noisy, near + rng.normal(scale=1.5e-3, size=near.shape), seed=1)


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


@pytest.mark.deep
def test_a_recording_is_shown_to_its_end(log, viewer, monkeypatch, capsys):
    said = []
    monkeypatch.setattr(live, "_has_display", lambda: False)
    monkeypatch.setattr(Panel, "finish", lambda self, words: said.append(words))
    assert live_of(log) == 0
    assert viewer[-1].row == 5
    assert viewer[-1].status.used == 6
    assert said[-1].endswith("the replay is over; nothing was written")
    told = capsys.readouterr()
    assert "live page: http://127.0.0.1:" in told.out
    assert "6 contacts" in told.out
    assert told.err.startswith("meshskin: no browser could be opened; open the page yourself\n")


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
        (["live", "x", "--port", "0", "--speed", "0"], "--speed"),
        (["live", "x", "--port", "70000"], "cannot be served"),
        (["live", "no_such_log", "--port", "0", "--scene", "sphere"], "no recording"),
        (["live", "x", "--port", "0", "--speed", "99"], "--speed is out of range, got 99"),
        (["run", "sphere", "--out", "o", "--speed", "2", "--no-browser"], "--speed, --no-browser"),
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


@pytest.mark.deep
def test_a_run_is_shown_before_its_results(noisy, viewer, monkeypatch, tmp_path, capsys):
    recording = touches(noisy, 9)
    with pytest.warns(ms.LeftOutWarning):
        found = ms.calibrate(recording, noisy.belief())

    def run(*arguments, watch, **options):
        watch(noisy, recording, found)
        raise ms.core.errors.StudyError("this is all that is tested")

    monkeypatch.setattr("meshskin.pipeline.run", run)
    code = main(["run", "sphere_noisy", "--out", str(tmp_path), "--live", "--port", "0",
                 "--no-browser", "--speed", "32"])  # fmt: skip
    assert code == 2
    assert viewer[-1].status.used == 18
    told = capsys.readouterr()
    assert "this is all" in told.err
    assert f"all contacts together: {found!r}" in told.out


@pytest.mark.deep
@pytest.mark.parametrize(("count", "words"), [(9, "8 of 80 taxels"), (1, "no calibration of all")])
def test_the_page_ends_with_the_calibration_of_all_contacts(
    noisy, viewer, monkeypatch, tmp_path, capsys, count, words
):
    shown = []
    monkeypatch.setattr(Panel, "conclude", lambda self, found: shown.append(found))
    touches(noisy, count).save(tmp_path / "log")
    assert live_of(str(tmp_path / "log"), "--no-browser") == 0
    assert words in capsys.readouterr().out
    assert len(shown) == (count == 9)


@pytest.mark.slow
def test_contacts_that_no_contact_model_describes_are_replayed(noisy, viewer, tmp_path, capsys):
    """Where the skin is believed softer than contact models reach, its response is learned."""
    rng = np.random.default_rng(0)
    points = noisy.skin.positions[:12].repeat(15, axis=0)
    recording = ms.press(noisy, points + rng.normal(scale=3e-3, size=points.shape), seed=1)
    ms.Recording(recording.contacts, recording.readings, {}).save(tmp_path / "log")
    noisy.body.mesh.export(tmp_path / "body.ply")
    skin = ["--body", str(tmp_path / "body.ply"), "--units", "m", "--young-kpa", "60"]
    options = ["--indenter-radius-mm", "10", "--port", "0", "--speed", "32"]
    assert main(["live", str(tmp_path / "log"), *skin, *options]) == 0
    assert viewer[-1].status.determined >= 10
    assert "the response is as learned from the whole log" in capsys.readouterr().out


@pytest.mark.deep
def test_any_error_of_the_last_calibration_is_shown_on_the_page(log, viewer, monkeypatch, capsys):
    def refuse(given):
        raise ContactError("the patch is too wide")

    said = []
    monkeypatch.setattr(live, "_calibrated", refuse)
    monkeypatch.setattr(Panel, "finish", lambda self, words: said.append(words))
    assert live_of(log, "--no-browser") == 0
    assert said[-1].startswith("no calibration of all contacts: the patch is too wide; the replay")
    assert "close it to end" in capsys.readouterr().out
