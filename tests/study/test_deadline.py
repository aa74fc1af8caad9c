"""A time that is asked for is a deadline: what does not fit is left out, named, or refused."""

import re
import subprocess
import sys
from pathlib import Path
from time import perf_counter, process_time

import numpy as np
import pytest

from meshskin import cli, pipeline
from meshskin.core import deadline
from meshskin.core.deadline import LEAST_SECONDS, Deadline
from meshskin.core.errors import OutOfTime, StudyError
from meshskin.estimation.calibrate import Estimation
from meshskin.estimation.comparison import METHODS, compare_methods
from meshskin.report import page
from meshskin.report.data import ReportData
from meshskin.scene.scene import Scene
from meshskin.study.sensitivity import choice, first_run
from meshskin.study.sensitivity.request import Request


def ends_in(seconds, slowdown=1.0):
    """A deadline `seconds` from now, on a machine that has been slow for 100 s of wall time."""
    return Deadline(100.0 + seconds, (perf_counter() - 100.0, process_time() - 100.0 / slowdown))


def test_a_deadline_counts_wall_time_and_reserves_processor_time():
    calm, busy = ends_in(10.0), ends_in(10.0, slowdown=4.0)
    assert calm.left == pytest.approx(10.0, abs=0.1)
    assert calm.slowdown == pytest.approx(1.0, abs=0.01)
    assert busy.slowdown == pytest.approx(4.0, abs=0.1)
    calm.check(5.0)
    heard = []
    busy.hook(lambda *at: heard.append(at), 2.0)("work", 1, 2)
    assert heard == [("work", 1, 2)]
    with pytest.raises(OutOfTime, match="the time is used up, got 110 s"):
        busy.hook(None, 5.0)("work", 1, 2)
    Deadline().check(1e9)


def test_methods_that_do_not_fit_are_left_out_and_named(noisy_recording, noisy):
    estimation = Estimation(noisy_recording, noisy.belief())
    seconds = {"centroid": 1.0}
    found = compare_methods(
        estimation, None, ends_in(20.0), 1.0, lambda method: seconds.get(method, 50.0)
    )
    assert list(found.found) == ["centroid"]
    assert found.left_out == tuple(method for method in METHODS if method != "centroid")
    assert all("no time within 120 s" in found.missing[method] for method in found.left_out)
    # without a prediction, the hook ends a method that takes too long
    late = compare_methods(estimation, None, ends_in(-1.0))
    assert late.left_out == METHODS


def test_a_calibration_ends_at_its_deadline(noisy_recording, noisy):
    with pytest.raises(OutOfTime):
        Estimation(noisy_recording, noisy.belief()).calibrate(progress=ends_in(1.0).hook(None, 2.0))


def test_a_time_in_which_no_run_can_end_is_refused_at_once(tmp_path, capsys):
    began = process_time()
    out = ["--out", str(tmp_path / "out")]
    assert cli.main(["run", "sphere", "--seconds", "0.001", *out]) == 2
    assert process_time() - began < 1.0
    line = capsys.readouterr().err
    assert "the time is too short, got 0.001 s, limit: a run takes" in line
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("seconds", "crowding", "pace", "least"),
    [
        (10.0, 1.0, 1.0, None),
        (10.0, 1.0, 1.2, 12.0),
        (10.0, 2.0, 1.0, 20.0),
        (18.0, 2.0, 1.0, None),
    ],
)
def test_a_run_is_refused_by_the_pace_and_the_crowd_of_the_machine(
    monkeypatch, seconds, crowding, pace, least
):
    """One of 10 s of processor time, which may end after 1.15 of the time."""
    monkeypatch.setattr(deadline, "crowding", lambda: crowding)
    monkeypatch.setattr(deadline, "pace", lambda: pace)
    if least is None:
        Deadline(seconds).check_run(10.0)
        return
    with pytest.raises(StudyError, match=rf"got {seconds:g} s, limit: a run takes {least:g}"):
        Deadline(seconds).check_run(10.0)


def test_a_run_is_refused_by_what_has_passed(monkeypatch):
    """Half a second of processor time tells how crowded the machine is, whatever it says now."""
    monkeypatch.setattr(deadline, "pace", lambda: 1.0)
    monkeypatch.setattr(deadline, "crowding", lambda: 9.0)
    ends_in(10.0, slowdown=4.0).check_run(6.0)
    with pytest.raises(StudyError, match=r"a run takes 1[45]"):
        ends_in(10.0, slowdown=4.0).check_run(11.0)
    Deadline().check_run(1e9)


def test_a_slow_machine_refuses_a_run_in_python(tmp_path, monkeypatch):
    monkeypatch.setattr(deadline, "crowding", lambda: 1.0)
    monkeypatch.setattr(deadline, "pace", lambda: 5.0)
    monkeypatch.setattr(pipeline, "_planned", lambda *a: pytest.fail("the run began"))
    with pytest.raises(StudyError, match=r"a run takes 10\.[5-9] s at least"):
        pipeline.run("sphere", tmp_path, request=Request(seconds=8.0))


@pytest.mark.slow
@pytest.mark.parametrize(("part", "ends"), [(1.3, True), (0.6, False)])
def test_the_least_time_is_that_of_a_run(tmp_path, part, ends):
    """In processor time, as on an idle machine: 30 % more is enough, 40 % less is not."""
    code = (
        "import sys, time; from meshskin.core import deadline; from meshskin import cli\n"
        "deadline.perf_counter, deadline.crowding = time.process_time, lambda: 1.0\n"
        "deadline.Deadline.check_run = lambda self, processor: None\n"
        "code = cli.main(sys.argv[1:]); print(code, time.process_time())"
    )
    asked = part * LEAST_SECONDS * deadline.pace()
    words = ["run", "sphere", "--quiet", "--seconds", str(asked), "--out", str(tmp_path)]
    done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True)
    ended, seconds = done.stdout.split()
    assert (ended == "0") is ends, (asked, done.stdout, done.stderr)
    assert not ends or float(seconds) < 1.2 * asked


def test_a_first_run_that_takes_all_the_time_is_refused(noisy):
    request = Request(seconds=100.0)
    with pytest.raises(
        StudyError, match="got 100 s, limit: a first run on wide lanes takes longer"
    ):
        choice.choose(noisy, request, METHODS, 0, ends_in(-20.0))


def test_a_first_run_may_take_15_percent_more_than_the_time(noisy, monkeypatch):
    given = []

    def never_ends(scene, seed, deadline, progress):
        given.append(deadline)
        raise OutOfTime("the time is used up")

    monkeypatch.setattr(choice, "first_run", never_ends)
    whole = Deadline(100.0)
    with pytest.raises(StudyError, match="a first run on wide lanes takes longer"):
        choice.choose(noisy, Request(seconds=100.0), METHODS, 0, whole)
    assert given == [Deadline(pytest.approx(115.0), whole.began)]


def test_a_budget_that_takes_all_the_time_is_refused(tmp_path, monkeypatch):
    def never_ends(scene, seed, progress):
        raise OutOfTime("the time is used up")

    monkeypatch.setattr("meshskin.study.sensitivity.budget.budget", never_ends)
    monkeypatch.setattr(Deadline, "check_run", lambda self, processor: None)
    with pytest.raises(
        StudyError, match=r"got 8 s, limit: .*budget takes longer; give more seconds"
    ):
        pipeline.run("sphere_noisy", tmp_path, request=Request(seconds=8.0), budget=1e-4)


def test_the_time_of_a_first_run_is_bounded_by_the_size_of_the_skin(noisy):
    """Measured on this scene: 1.3 s of processor time; on twelve times the taxels at least 20 s."""
    assert 0.5 < first_run.least_seconds(noisy) < 1.3
    skin = noisy.skin.cover(noisy.body, spacing=5e-3, count=1000)
    assert 10.0 < first_run.least_seconds(noisy.with_(skin=skin)) < 20.0


def test_a_first_run_ends_as_soon_as_its_pace_is_known(noisy, monkeypatch):
    """A loop of 100 s, of which a tenth has passed: not after half of it, when the time is over."""
    seen = []

    def slow(scene, machine, path, progress):
        for done in range(1, 101):
            seen.append(done)
            clock[0] += 1.0
            progress("simulate", done, 100)
            yield

    clock = [0.0]
    monkeypatch.setattr(Deadline, "spent", property(lambda self: (clock[0], clock[0])))
    monkeypatch.setattr(first_run, "run", slow)
    with pytest.raises(OutOfTime):
        first_run.first_run(noisy, 0, Deadline(50.0))
    assert seen[-1] == 11


@pytest.mark.parametrize(
    ("at", "drawn"), [(0, set()), pytest.param(3, {"fig5_estimates"}, marks=pytest.mark.deep)]
)
def test_figures_that_do_not_fit_are_left_out_and_named(
    noisy_recording, noisy, tmp_path, at, drawn
):
    """Also where the time is used up before the first one."""

    def late(stage, done, total):
        if done == at:
            raise OutOfTime("the time is used up")

    found = Estimation(noisy_recording, noisy.belief()).calibrate("centroid")
    data = ReportData(found, truth=noisy.skin)
    written, left_out = page.draw(tmp_path / "report.html", data, late)
    assert {file.stem for file in written} == {"report", *drawn}
    last = ["errors", "uncertainty", "coverage", "iterations", "accuracy time"]
    assert left_out[-5:] == last
    assert ("estimates" in left_out) is not bool(drawn)
    named = ", ".join(left_out[:2])
    assert f"Not drawn, because there was no time: {named}" in written[0].read_text()


@pytest.mark.slow
@pytest.mark.parametrize("late", ["pilot", "simulate", "calibrate"])
def test_a_run_that_falls_behind_reports_its_first_run(tmp_path, monkeypatch, late):
    """The time runs out in a stage: the scene on wide lanes is the result, and the page says so."""
    ends = []

    def late_hook(self, progress=None, reserve=0.0):
        def hook(stage, done, total):
            if stage == late and (late != "pilot" or done == 5):
                ends.append(stage)
                raise OutOfTime("the time is used up")

        return hook

    calibrate = Estimation.calibrate
    monkeypatch.setattr(Deadline, "hook", late_hook)
    if late == "calibrate":  # that of the first run succeeds
        seen = []

        def first_only(self, *args, **kwargs):
            seen.append(self.recording)
            kept = dict(kwargs) if self.recording is not seen[0] else {}
            return calibrate(self, *args[: 4 if kept else 3], **kept)

        monkeypatch.setattr(Estimation, "calibrate", first_only)
    if late == "simulate":
        monkeypatch.setattr(
            "meshskin.study.sensitivity.first_run.run", lambda s, m, p, _: pipeline_run(s, m, p)
        )
    result = pipeline.run("sphere_noisy", tmp_path, seed=1, request=Request(accuracy_mm=0.05))
    assert ends
    promise = result.metrics["promise"]
    assert promise["error_mm"] is None
    assert "because" in promise["setting"]
    assert len(result.recording.time) < 2000
    assert result.recording.motion is not None
    assert np.isfinite(result.metrics["position_error_mm"]["mean"])
    assert "because" in (tmp_path / "report.html").read_text()


def pipeline_run(scene, machine, path):
    """The closed loop without a hook."""
    from meshskin.simulation.simulate import run

    return run(scene, machine, path)


def test_a_crowded_machine_refuses_before_the_packages_are_read(tmp_path, capsys, monkeypatch):
    """Or a slow one: by the wall time that the same processor time takes, or by its pace."""
    monkeypatch.setattr(pipeline, "run", lambda *a, **k: pytest.fail("the run began"))
    for crowding, pace in ((5.0, 1.0), (2.5, 2.0)):
        monkeypatch.setattr("meshskin.core.deadline.crowding", lambda found=crowding: found)
        monkeypatch.setattr("meshskin.core.deadline.pace", lambda found=pace: found)
        assert cli.main(["run", "sphere", "--seconds", "12", "--out", str(tmp_path / "out")]) == 2
        assert re.search(r"a run takes 1[45](\.\d)? s at least", capsys.readouterr().err)


def test_a_large_mesh_is_refused_before_it_is_read(tmp_path, monkeypatch):
    """Its file alone says that it takes longer: 1 GB, of which the disk holds the beginning."""
    with (tmp_path / "large.stl").open("wb") as file:
        file.write(bytes(84))
        file.truncate(10**9)
    scene = tmp_path / "large.toml"
    scene.write_text('[body]\nmesh = "large.stl"\nunits = "mm"\n[skin]\nspacing_mm = 5\n')
    monkeypatch.setattr(Scene, "from_tables", lambda *_: pytest.fail("the mesh was read"))
    with pytest.raises(StudyError, match=r"too short, got 60 s, limit: a run takes \d+ s at least"):
        pipeline.run(scene, tmp_path / "out", request=Request(seconds=60.0))


def test_a_mesh_with_a_large_texture_is_not_refused_by_its_size(tmp_path):
    """A glTF file of 1,280 faces and 108 MB of texture is loaded in 0.2 s."""
    with (tmp_path / "textured.glb").open("wb") as file:
        file.truncate(10**8)
    assert first_run.least_loading({"body": {"mesh": "textured.glb"}}, tmp_path) == 0.0


def test_the_pace_is_that_of_this_process():
    """Measured of the work alone, whatever else the process has done or waited for."""
    found = [deadline.pace() for _ in range(3)]
    assert 0.1 < min(found) < 10.0
    began = process_time()
    deadline.pace()
    assert process_time() - began < 0.2


def test_a_machine_is_crowded_by_the_less_of_what_tells_it(monkeypatch):
    def after(waited, load, running):
        """Of 1 s on a processor and `waited` seconds of waiting for one."""
        monkeypatch.setattr(deadline.os, "getloadavg", lambda: (load, load, load))
        monkeypatch.setattr(deadline.os, "cpu_count", lambda: 2)
        words = {
            "/proc/self/schedstat": f"1000000000 {round(1e9 * waited)} 60",
            "/proc/loadavg": f"{load} {load} {load} {running}/300 4711",
        }
        monkeypatch.setattr(deadline.Path, "read_text", lambda self: words[str(self)])
        return deadline.crowding()

    assert after(0.0, 8.0, 8) == 1.0
    assert after(2.0, 8.0, 8) == 3.0
    assert after(8.0, 8.0, 6) == 3.0
    assert after(8.0, 5.0, 8) == 2.5
    assert after(8.0, 0.5, 1) == 1.0
    monkeypatch.setattr(deadline.Path, "read_text", lambda self: "")
    assert deadline.crowding() == 1.0


@pytest.mark.deep
@pytest.mark.skipif(not Path("/proc/self/schedstat").exists(), reason="needs Linux")
def test_a_process_that_shares_its_processor_is_crowded():
    """Four at once on one processor: each runs for a quarter of the time."""
    code = (
        "import os, time; os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})\n"
        "from meshskin.core import deadline\n"
        "while time.process_time() < 0.4: pass\n"
        "deadline.os.getloadavg, deadline.os.cpu_count = lambda: (99.0,), lambda: 1\n"
        "print(deadline.crowding())"
    )
    running = [
        subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
        for _ in range(4)
    ]
    assert max(float(process.communicate()[0]) for process in running) > 1.5


def test_a_crowded_machine_has_taken_longer_until_a_command_begins(monkeypatch):
    monkeypatch.setattr(deadline, "crowding", lambda: 3.0)
    began = deadline.command_began()
    assert perf_counter() - began[0] == pytest.approx(3 * deadline.STARTED, abs=0.05)
    assert process_time() - began[1] == pytest.approx(deadline.STARTED, abs=0.05)


@pytest.mark.deep
def test_a_command_begins_with_its_work_however_old_its_process_is():
    """A shell that waits and is replaced by the command, as in a container, keeps its start."""
    code = (
        "from time import perf_counter; from meshskin.core.deadline import command_began; "
        "print(perf_counter() - command_began()[0])"
    )
    words = ["sh", "-c", 'sleep 2; exec "$0" -c "$1"', sys.executable, code]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    assert deadline.STARTED - 0.05 < float(done.stdout) < 2.0
