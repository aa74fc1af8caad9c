"""Cards, pictures and tables of objects, as a notebook shows them."""

import builtins
import time
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest

import meshskin as ms
from meshskin.core import drawing
from meshskin.core.errors import CalibrationError, ConfigError
from meshskin.core.notebook import Card

IMAGE = "data:image/png;base64,"


@pytest.fixture(scope="module")
def calibration(recording, sphere):
    return ms.calibrate(recording, sphere.belief(), "centroid")


@pytest.fixture(scope="module")
def plan(sphere):
    return ms.explore(sphere.body, sphere.skin, mode="quasi_static")


@pytest.mark.deep
def test_cards_have_numbers_and_a_picture(sphere, recording, calibration, plan):
    for shown, words in (
        (sphere.body, ("sphere", "200 x 200 x 200 mm", "5,120")),
        (sphere.skin, ("80", "2 mm radius")),
        (sphere, ("6 joints", "3 N on 200 kPa")),
        (recording, ("contacts", "80 read of 80")),
        (calibration, ("80 of 80 determined", "centroid")),
        (calibration.skin, ("median", "sphere")),
        (plan, ("segments", "taxels left out")),
    ):
        html = shown._repr_html_()
        assert type(shown).__name__ in html
        assert IMAGE in html
        for text in words:
            assert text in html, text
        assert "no picture" not in html
        assert "not shown" not in html


def test_planned_touches_are_tables(recording, sphere):
    found = ms.calibrate(recording, sphere.belief(), "trilateration")
    planned, design = found.next_contacts(3), ms.next_touches(found, k=2, units=found.ids[:3])
    for touches, last in ((planned, planned.taxel), (design, design.unit)):
        table = touches.to_arrow()
        np.testing.assert_array_equal(table["y"], touches.points[:, 1])
        np.testing.assert_array_equal(table["nz"], touches.normals[:, 2])
        assert table[6].to_pylist() == last.tolist()
        assert len(repr(touches)) < 150


def test_a_scale_of_colours_has_its_values_in_its_middle():
    points = np.eye(3)
    shown = drawing.solid(None, points=points, normals=points, values=np.array([3.0, 3.0, 3.01]))
    low, high = shown.axes[-1].get_ylim()
    assert low < 3.0 < 3.01 < high
    assert 3.0 - low == pytest.approx(high - 3.01)


def test_few_dots_without_a_size_are_large_and_many_small():
    """Relative to the extent of the picture."""

    def disc(count, radius=0.0):
        points = np.random.default_rng(count).normal(size=(count, 3))
        shown = drawing.solid(None, points=points, values=np.arange(count), radius=radius)
        (dots,) = shown.axes[0].collections
        at = dots.get_offsets()
        return dots.get_widths()[0] / 2 / np.ptp(at, axis=0).max()

    assert disc(36) == pytest.approx(drawing.MOST_DISC)
    assert disc(100) == pytest.approx(0.012)
    assert disc(1000) == pytest.approx(drawing.LEAST_DISC)
    assert disc(36, radius=1e-6) == pytest.approx(drawing.LEAST_DISC)


def test_a_card_of_a_bad_state_says_so(calibration):
    lost = replace(calibration, poses=np.full_like(calibration.poses, np.nan))
    html = lost._repr_html_()
    assert "0 of 80 determined" in html
    assert "no taxel is determined" in html
    assert IMAGE not in html
    broken = object.__new__(ms.Skin)  # without any field
    assert "not shown" in broken._repr_html_()
    empty = ms.Skin(np.zeros((0, 4, 4)), np.zeros(0, dtype=int))
    assert "taxels" in empty._repr_html_()


def test_texts_are_escaped():
    class Odd(Card):
        def facts(self):
            return {"name": "<script>"}

    assert "<script>" not in Odd()._repr_html_()


def test_a_large_mesh_is_drawn_coarser():
    body = ms.Body.ellipsoid((0.05, 0.08, 0.1), faces=60_000)
    begin = time.process_time()
    html = body._repr_html_()
    assert time.process_time() - begin < 1.5  # 0.1 s on an idle core
    assert IMAGE in html
    vertices, faces = drawing.coarser(body.mesh.vertices, body.mesh.faces)
    assert 2000 < len(faces) < 40_000
    np.testing.assert_allclose(np.ptp(vertices, axis=0), body.mesh.extents, rtol=0.03)


def test_a_picture_shows_body_and_taxels(sphere):
    for close in (False, True):  # without a taxel
        ms.Skin(np.zeros((0, 4, 4)), []).plot(body=sphere.body, close=close)
    figure = sphere.skin.plot(body=sphere.body)
    figure.canvas.draw()
    import io

    from PIL import Image

    pixels = np.asarray(Image.open(io.BytesIO(figure._repr_png_())).convert("RGB"), dtype=int)
    blue = np.all(np.abs(pixels - [0, 0x72, 0xB2]) < 8, axis=2)
    grey = (np.ptp(pixels, axis=2) < 20) & (pixels.max(axis=2) < 225) & (pixels.min(axis=2) > 80)
    disc = (np.pi * 2e-3**2) * 80 / (np.pi * 0.1**2)  # of the taxels, seen from the front
    assert blue.sum() / (blue | grey).sum() == pytest.approx(disc, rel=0.25)


def test_pictures_are_drawn_into_given_axes(sphere, recording):
    from matplotlib.figure import Figure

    figure = Figure()
    one, two = figure.subplots(1, 2)
    assert sphere.plot(ax=one) is figure
    assert recording.plot(ax=two) is figure


def test_tables(calibration, recording, plan):
    table = calibration.to_arrow()
    assert isinstance(table, pa.Table)
    frame = calibration.to_pandas()
    np.testing.assert_array_equal(frame[["x", "y", "z"]], calibration.positions)
    np.testing.assert_array_equal(frame["sigma"], calibration.position_sigma)
    assert recording.to_pandas("readings").shape == (len(recording.readings), 3)
    with pytest.raises(ConfigError, match="table of a recording"):
        recording.to_pandas("reading")
    assert len(plan.to_pandas()) == len(plan.path.points)
    assert calibration.skin.to_arrow().column_names[-1] == "sigma"


def test_pandas_is_optional(calibration, monkeypatch):
    real = builtins.__import__

    def without(name, *args, **kwargs):
        if name == "pandas":
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ConfigError, match="pip install pandas"):
        calibration.to_pandas()


def test_the_skin_of_a_calibration_is_saved_with_its_sigmas(calibration, tmp_path):
    for suffix in ("csv", "txt", "urdf", "xml", "npz", "yaml", "ply", "glb"):
        calibration.skin.save(tmp_path / f"map.{suffix}")
        read = ms.Skin.load(tmp_path / f"map.{suffix}")
        np.testing.assert_allclose(read.sigmas, calibration.position_sigma, rtol=1e-12)
        if suffix != "txt":
            assert read.frame == "sphere"
    lost = replace(calibration, poses=np.full_like(calibration.poses, np.nan))
    with pytest.raises(CalibrationError, match="no taxel"):
        _ = lost.skin
