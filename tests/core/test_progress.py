"""The hook of long work: what it is told, and that what it raises ends the work cleanly."""

import numpy as np
import pytest

import meshskin as ms
from meshskin.cli.progress_bar import bar, pace
from meshskin.core import se3
from meshskin.core.progress import Stage
from meshskin.simulation import static_contacts

BODY = ms.Body.ellipsoid((0.05, 0.06, 0.08))


class Heard(list):
    """A hook that keeps what it is told, and raises when a stage has done `most` steps."""

    def __init__(self, most=None):
        self.most = most

    def __call__(self, stage, done, total):
        self.append((stage, done, total))
        if done == self.most:
            raise KeyboardInterrupt


def test_a_stage_counts_to_its_end_whatever_was_usual():
    heard = Heard()
    stage = Stage(heard, "work", 2)
    for _ in range(3):
        stage.step()
    stage.expect(4)
    stage.step()
    stage.end()
    assert heard == [("work", *at) for at in ((0, 2), (1, 2), (2, 2), (3, 3), (4, 7), (4, 4))]
    Stage().step()  # without a hook


@pytest.fixture(scope="module")
def pressed(noisy):
    """300 contacts of the noisy sphere."""
    near = np.random.default_rng(0).normal(scale=12e-3, size=(150, 3))
    return ms.press(noisy, noisy.skin.positions.mean(axis=0) + near, seed=1)


@pytest.mark.deep
@pytest.mark.filterwarnings("ignore::meshskin.core.errors.LeftOutWarning")
@pytest.mark.parametrize("method", ["joint", "posegraph"])
def test_a_calibration_tells_its_steps_and_can_be_interrupted_in_each(pressed, noisy, method):
    heard, belief = Heard(), noisy.belief()
    found = ms.calibrate(pressed, belief, method, progress=heard)
    steps = [done for _, done, _ in heard]
    assert steps == sorted(steps)
    assert len(set(steps)) > 2
    assert heard[-1][1] == heard[-1][2]
    silent = ms.calibrate(pressed, belief, method)
    np.testing.assert_array_equal(found.positions, silent.positions)
    for most in (0, max(steps) - 1):
        with pytest.raises(KeyboardInterrupt):
            ms.calibrate(pressed, belief, method, progress=Heard(most))


@pytest.mark.deep
def test_an_interrupted_simulation_leaves_no_file(sphere, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        ms.simulate(sphere, out=tmp_path / "recording", progress=Heard(1))
    hook = Heard()

    def late(stage, done, total):
        hook(stage, done, total)
        if stage == "simulate" and done > total // 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        ms.simulate(sphere, out=tmp_path / "recording", progress=late)
    assert hook[-1][0] == "simulate"
    assert not list(tmp_path.iterdir())


def test_a_pose_graph_tells_its_iterations_and_can_be_interrupted_in_each():
    """Also from inside IPOPT, which calls the hook."""
    poses = se3.transform(se3.exp_so3(np.linspace(0, 1, 24).reshape(8, 3)), np.eye(8, 3))
    edges = np.array([(i, j) for i in range(8) for j in range(i)])
    measured = se3.inverse(poses[edges[:, 0]]) @ poses[edges[:, 1]]
    measured[:, :3, 3] += 0.01 * np.sin(np.arange(84.0)).reshape(28, 3)
    graph = ms.PoseGraph(poses, edges, measured, np.tile(np.eye(6), (28, 1, 1)))
    heard = Heard()
    found = graph.solve(start="tree", progress=heard)
    assert heard[0][1] == 0
    assert heard[-1] == ("solve", found.iterations, found.iterations)
    with pytest.raises(KeyboardInterrupt):
        graph.solve(start="tree", progress=Heard(1))
    again = graph.solve(start="tree", keep_iterates=True)
    assert (again.poses == found.poses).all()
    assert len(again.iterates) == found.iterations + 1


def test_presses_tell_their_batches(sphere, monkeypatch):
    monkeypatch.setattr(static_contacts, "BATCH_CELLS", 10 * len(sphere.skin))
    heard, points = Heard(), sphere.skin.positions[:25]
    found = ms.press(sphere, points, progress=heard)
    assert heard == [("press", k, 3) for k in range(4)]
    monkeypatch.undo()
    again = ms.press(sphere, points)  # made in another second, as its provenance says
    assert (found.contacts, found.readings) == (again.contacts, again.readings)


@pytest.mark.deep
def test_a_layout_tells_its_rings_and_projections():
    heard = Heard()
    found = ms.Skin.cover(BODY, spacing=20e-3, progress=heard)
    assert {stage for stage, _, _ in heard} == {"cover"}
    assert [done for _, done, _ in heard[:-1]] == list(range(len(heard) - 1))
    assert heard[-1][1] == heard[-1][2] > 10
    assert found == ms.Skin.cover(BODY, spacing=20e-3)
    with pytest.raises(KeyboardInterrupt):
        ms.Skin.cover(BODY, spacing=20e-3, progress=Heard(3))


@pytest.mark.filterwarnings("ignore::meshskin.core.errors.LeftOutWarning")
def test_planned_touches_are_told_one_by_one(pressed, noisy):
    found, heard = ms.calibrate(pressed, noisy.belief(), "trilateration"), Heard()
    planned = found.next_contacts(4, progress=heard)
    assert heard == [("next contacts", k, 5) for k in range(6)]
    assert planned == found.next_contacts(4)
    heard.clear()
    ids = noisy.skin.ids[:3]
    design = ms.next_touches(noisy.skin, noisy.belief(), 2, ids, progress=heard)
    assert heard == [("next touches", k, 3) for k in range(4)]
    assert design == ms.next_touches(noisy.skin, noisy.belief(), 2, ids)


@pytest.mark.filterwarnings("ignore::meshskin.core.errors.LeftOutWarning")
def test_an_interrupted_report_leaves_the_page_before_it(pressed, noisy, tmp_path):
    found = ms.calibrate(pressed, noisy.belief(), "centroid")
    page = tmp_path / "report.html"
    page.write_text("before")
    with pytest.raises(KeyboardInterrupt):
        found.report(page, progress=Heard(3))
    assert page.read_text() == "before"
    assert not [
        file for file in tmp_path.rglob("*") if file.suffix not in (".html", ".png", ".svg", "")
    ]


@pytest.mark.parametrize(
    ("rate", "name", "words"),
    [
        (1 / 2.1, "case", ", 2.1 s/case"),
        (3.21, "case", ", 3.2 cases/s"),
        (29_000.0, "path point", ", 29,000 path points/s"),
        (5.0, "", ""),
        (None, "case", ""),
    ],
)
def test_a_pace_reads_well(rate, name, words):
    assert pace(rate, name) == words


def test_without_a_terminal_each_stage_that_ended_is_one_line(capsys):
    with bar(quiet=False) as progress:
        for stage, total in (("load", 1), ("simulate", 3), ("calibrate", 2)):
            for done in range(total + (stage != "calibrate")):
                progress(stage, done, total)
    lines = capsys.readouterr().err.splitlines()
    assert [line.split()[0] for line in lines] == ["load", "simulate"]
    assert all(line.endswith(" s") for line in lines)
    with bar(quiet=True) as progress:
        assert progress is None
