"""Nodes of the live page's 3D view, its panel, and how it starts; without a browser."""

import socket
import sys
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest

import meshskin as ms
from meshskin.core.errors import ConfigError
from meshskin.core.se3 import inverse
from meshskin.report.live import drawing as module
from meshskin.report.live import marks
from meshskin.report.live.page import LivePage, check_port, import_viser
from meshskin.report.live.panel import rows_of
from meshskin.report.live.stage import Stage

from .conftest import status

pytest.importorskip("viser", reason='no viser: pip install "meshskin[live]"')


@pytest.fixture(scope="module")
def page(stage):
    with LivePage(stage, "127.0.0.1", 0, 2.0) as page:
        yield page


def pose(node) -> np.ndarray:
    """Pose (4, 4) of a node."""
    from scipy.spatial.transform import Rotation

    out = np.eye(4)
    out[:3, :3] = Rotation.from_quat(np.roll(node.wxyz, -1)).as_matrix()
    out[:3, 3] = node.position
    return out


def test_everything_has_a_node(page, stage):
    marks = ("mesh", "taxels", "sigma", "truth", "indenter", "indenter/support", "patch", "next")
    assert {f"/body/{name}" for name in marks} <= set(page.drawing.nodes)
    assert {f"/world/robot/{link}" for link in stage.carrier.links} <= set(page.drawing.nodes)


def test_a_stage_without_robot_and_truth_has_none_of_theirs(noisy, touched):
    bare = Stage.of_recording(replace(touched, motion=None), noisy.belief())
    with LivePage(bare, "127.0.0.1", 0, 1.0) as page:
        names = set(page.drawing.nodes)
        assert set(page.panel.view.options) == {module.SKIN, module.BODY}
    assert "/body/truth" not in names
    assert "/body/indenter/support" not in names
    assert not any(name.startswith("/world/robot") for name in names)


def test_taxels_have_the_place_the_size_and_the_color_of_their_estimate(page, noisy, snapshot):
    page.show(snapshot)
    taxels = page.drawing.nodes["/body/taxels"]
    moved = np.linalg.norm(taxels.batched_positions[2:] - snapshot.positions[2:], axis=1)
    np.testing.assert_allclose(moved, module.LIFT, atol=1e-7)
    np.testing.assert_allclose(taxels.batched_scales[2:], noisy.skin.disc_radius, rtol=1e-6)
    sigma = np.sqrt(2) * 2e-5
    expected = marks.linear(marks.sigma_colors(np.full(78, sigma)))
    np.testing.assert_array_equal(taxels.batched_colors[2:], expected)


def test_a_weak_taxel_is_white_and_an_unseen_one_is_hidden(page, noisy, snapshot):
    page.show(snapshot)
    taxels, sigma = (page.drawing.nodes[f"/body/{name}"] for name in ("taxels", "sigma"))
    assert taxels.batched_colors[0].tolist() == marks.linear(marks.UNSEEN).tolist()
    assert taxels.batched_scales[0, 0] == pytest.approx(noisy.skin.disc_radius)
    assert taxels.batched_scales[1].tolist() == pytest.approx([module.HIDDEN] * 3)
    assert sigma.batched_scales[:2].max() == pytest.approx(module.HIDDEN)


def test_ellipsoids_shrink_with_sigma(page, snapshot):
    sizes = []
    for factor in (1.0, 0.25):
        page.show(replace(snapshot, covariances=factor * snapshot.covariances))
        sizes.append(np.array(page.drawing.nodes["/body/sigma"].batched_scales[2:, 2]))
    np.testing.assert_allclose(sizes[0], marks.MAGNIFIED * 2e-5, rtol=1e-4)
    np.testing.assert_allclose(sizes[1], np.maximum(sizes[0] / 2, marks.MIN_AXIS), rtol=1e-4)


def test_the_next_touch_is_marked_while_there_is_one(page, snapshot):
    page.show(snapshot)
    arrow = page.drawing.nodes["/body/next"]
    np.testing.assert_allclose(arrow.position, [0, 0, -0.1], atol=1e-6)
    np.testing.assert_allclose(pose(arrow)[:3, 2], [0, 0, -1], atol=1e-6)
    assert arrow.visible
    page.show(replace(snapshot, status=status(next_touch=None)))
    assert not arrow.visible


def test_the_patch_has_the_size_and_the_place_of_the_contact(page, stage, snapshot):
    page.show(snapshot)
    patch, contact = page.drawing.nodes["/body/patch"], stage.contact(snapshot.row)
    np.testing.assert_allclose(patch.scale[:2], contact.semi_axes, rtol=1e-6)
    lift = np.linalg.norm(pose(patch)[:3, 3] - stage.recording.points[snapshot.row])
    assert lift == pytest.approx(2 * module.LIFT, abs=2e-5)
    assert patch.visible


def test_all_views_show_the_robot_in_the_same_place_of_the_body(page, stage, snapshot):
    page.show(snapshot)
    nodes, seen = page.drawing.nodes, []
    for view in module.VIEWS:
        page.panel.view.value = view
        page._turn()
        seen.append(np.linalg.inv(pose(nodes["/body"])) @ pose(nodes["/world"]))
    np.testing.assert_allclose(seen[1:], [seen[0]] * 2, atol=1e-6)
    np.testing.assert_allclose(seen[0], inverse(stage.carrier.body[snapshot.row]), atol=1e-6)
    np.testing.assert_allclose(pose(nodes["/world"]), np.eye(4), atol=1e-9)


def test_the_camera_looks_at_the_skin_from_outside(page, stage):
    page.drawing.view = module.SKIN
    position, target, _ = page.drawing.camera(0)
    assert np.linalg.norm(target - stage.recording.points.mean(axis=0)) < 5e-3
    assert stage.belief.body.closest(position[None]).distance[0] > 0.02


def test_the_camera_frames_the_whole_body(page, stage):
    page.drawing.view = module.BODY
    position, target, _ = page.drawing.camera(0)
    away = stage.belief.body.mesh.vertices - position
    cosine = away @ (target - position) / np.linalg.norm(target - position)
    angles = np.degrees(np.arccos(cosine / np.linalg.norm(away, axis=1)))
    assert 25 < angles.max() < 37.5  # half the height of viser's view


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_the_camera_is_outside_where_a_log_has_no_normals(page, stage, monkeypatch, side):
    """Of the points alone, one side of the plane is as good as the other."""
    contacts, none = stage.recording.contacts, np.full(len(stage.recording.time), np.nan)
    columns = {name: contacts[name].to_numpy() for name in contacts.column_names}
    columns |= {name: side * columns[name] for name in ("px", "py", "pz")}
    columns |= dict.fromkeys(("nx", "ny", "nz"), none)
    table = pa.table(list(columns.values()), schema=contacts.schema)
    recording = ms.Recording(table, stage.recording.readings, stage.recording.metadata)
    monkeypatch.setattr(page.drawing, "stage", replace(stage, recording=recording))
    page.drawing.view = module.SKIN
    position, _, _ = page.drawing.camera(0)
    assert stage.belief.body.closest(position[None]).distance[0] > 0.02


def test_curves_grow_with_the_snapshots(stage, snapshot):
    with LivePage(stage, "127.0.0.1", 0, 1.0) as page:
        for row in (2, 5, 9):
            page.show(replace(snapshot, row=row))
        time, force = page.panel.force.data
        contacts, median, worst = page.panel.sigma.data
        assert page.panel.residual.data[1].tolist() == [1.1] * 3
    assert time[-1] - time[0] <= 10.0
    np.testing.assert_allclose(force, 3.0)
    assert contacts.tolist() == [3, 6, 10]
    np.testing.assert_allclose([median[0], worst[0]], [0.02, 0.3])


def test_the_panel_says_verdict_and_end_in_words(page, snapshot):
    page.show(replace(snapshot, status=status(verdict="model misfit", why="x < y")))
    assert "model misfit" in page.panel.verdict.content
    assert "x &lt; y" in page.panel.verdict.content
    page.panel.finish("it is over")
    assert "model misfit" in page.panel.verdict.content
    assert "it is over" in page.panel.verdict.content


def test_numbers_have_units(snapshot):
    rows = dict(rows_of(snapshot, 2e5, 0.03))
    assert rows["taxels"] == "78 determined, 1 weak, 1 unseen"
    assert rows["sigma"] == "median 0.0200 mm, worst 0.300 mm"
    assert rows["next touch"] == "at (0.0, 0.0, −100.0) mm, for taxel 7"
    assert rows["E*"] == "400 ± 13 kPa"  # 1 % by the readings, 3 % by the indenter's radius


def test_what_only_priors_determine_and_what_moved_is_named(snapshot):
    nothing = {"median_sigma": np.nan, "worst_sigma": np.nan, "next_touch": None}
    words = {"undetermined": ("force_scale",), "moved": tuple(range(11))}
    rows = dict(rows_of(replace(snapshot, status=status(**nothing, **words)), 2e5, 0.03))
    assert rows["sigma"] == "median –, worst –"
    assert rows["next touch"] == "none"
    assert rows["by priors only"] == "force_scale"
    assert rows["moved"] == "0, 1, 2, 3, 4, 5, 6, 7 and 3 more"


def test_a_port_in_use_is_one_line():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(ConfigError, match=r"cannot be served, got 127.0.0.1:\d+ .*--port"):
            check_port("127.0.0.1", taken.getsockname()[1])


@pytest.mark.parametrize(("host", "port"), [("no.such.host.invalid", 0), ("127.0.0.1", 70000)])
def test_a_host_or_port_that_does_not_exist_is_refused(host, port):
    with pytest.raises(ConfigError, match="cannot be served"):
        check_port(host, port)


def test_without_viser_the_pip_command_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(ConfigError, match=r'pip install "meshskin\[live\]"'):
        import_viser()


def test_the_end_shows_the_calibration_of_all_contacts(page, noisy, snapshot):
    near = noisy.skin.positions[:2].repeat(9, axis=0)
    places = near + np.random.default_rng(0).normal(scale=1.5e-3, size=near.shape)
    with pytest.warns(ms.LeftOutWarning):
        found = ms.calibrate(ms.press(noisy, places, seed=1), noisy.belief())
    page.show(snapshot)
    page.conclude(found)
    taxels, known = page.drawing.nodes["/body/taxels"], np.isfinite(found.positions[:, 0])
    apart = np.linalg.norm(taxels.batched_positions - found.positions, axis=1)[known]
    np.testing.assert_allclose(apart, module.LIFT, atol=1e-7)
    assert (taxels.batched_scales[~known] == np.float32(module.HIDDEN)).all()
    assert not page.drawing.nodes["/body/next"].visible
    assert found.verdict.level in page.panel.verdict.content
    assert f"{known.sum()} of 80" in page.panel.numbers.content
