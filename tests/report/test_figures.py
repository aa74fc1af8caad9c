"""Figures show their data, and accept missing values."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import matplotlib
import numpy as np
import pyarrow as pa
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image

from meshskin.core.errors import OutputError
from meshskin.geometry.body import Body
from meshskin.report import curves, maps, precision, scene3d, theme
from meshskin.report.curves import envelope
from meshskin.report.data import Iterations, ReportData, method_name
from meshskin.report.maps import ellipse_axes, representative_iterations
from meshskin.report.plane import drawn_scale, path_with_breaks, pitch
from meshskin.report.theme import compact, significant


def texts(figure: object) -> str:
    """All visible text of a figure, in one string."""
    import matplotlib.text

    return " | ".join(t.get_text() for t in figure.findobj(matplotlib.text.Text))  # type: ignore[attr-defined]


@pytest.mark.deep
def test_importing_the_report_imports_no_plotting_library() -> None:
    code = (
        "import sys, meshskin.report, meshskin.report.page, meshskin.report.figure_set\n"
        "sys.exit(any(m in sys.modules for m in ('matplotlib', 'plotly')))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_drawing_leaves_matplotlib_as_it_was() -> None:
    before = matplotlib.rcParams.copy()
    curves.force([0.0, 1.0], [0.0, 3.0], 3.0)
    assert matplotlib.rcParams.copy() == before


@pytest.mark.slow
def test_drawing_never_imports_pyplot() -> None:
    code = (
        "import sys\nfrom meshskin.report import curves, maps, theme\n"
        "curves.force([0.0, 1.0], [0.0, 3.0], 3.0)\n"
        "sys.exit('matplotlib' not in sys.modules or 'matplotlib.pyplot' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.deep
def test_save_writes_png_and_svg(tmp_path: Path) -> None:
    figure = curves.force([0.0, 1.0], [0.0, 3.0], 3.0)
    png, svg = theme.save(figure, tmp_path / "figures", "force")
    assert png.read_bytes().startswith(b"\x89PNG")
    assert "<svg" in svg.read_text()
    assert sorted(p.name for p in (tmp_path / "figures").iterdir()) == ["force.png", "force.svg"]


def test_the_raster_has_all_that_the_svg_has_in_its_place(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    figure = theme.new_figure(4.0, 3.0)
    axes = theme.add_axes(figure, 0.6, 0.5, 2.2, 2.2)
    many = rng.random((2, 600))
    axes.plot(*many, ".", rasterized=True)
    axes.plot([-1.0, 2.0], [0.0, 1.0], lw=3, label="clipped")
    axes.plot([0.2, 0.8], [0.8, 0.2], "s", ms=20)
    dots = axes.scatter(*rng.random((2, 9)), c=np.arange(9.0))
    theme.color_bar(figure, dots, axes, "numbers")
    axes.set(xlim=(0, 1), ylim=(0, 1), title="everything")
    axes.legend()
    alone = FigureCanvasAgg(figure)
    alone.draw()
    expected = np.asarray(alone.buffer_rgba())[..., :3].astype(float)
    drawn = np.asarray(Image.open(theme.save(figure, tmp_path, "all")[0])).astype(float)
    assert drawn.shape == expected.shape
    assert np.mean(np.abs(drawn - expected)) < 0.8  # letters are hinted to other pixels


def test_save_names_a_folder_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OutputError):
        theme.save(curves.force([0.0, 1.0], [0.0, 3.0], 3.0), tmp_path / "file", "force")


def test_the_envelope_keeps_a_single_spike() -> None:
    t, f = np.linspace(0, 10, 50_000), np.zeros(50_000)
    f[31_234] = 7.0
    x, y = envelope(t, f)
    assert len(x) == len(y) <= 1400
    assert y.max() == 7.0
    assert x[np.argmax(y)] == pytest.approx(t[31_234], abs=10 / 700)


def test_force_names_its_settling_and_works_without_reference() -> None:
    t = np.arange(0.0, 2.0, 1e-3)
    f = 3.0 * (1 - np.exp(-np.maximum(t - 0.5, 0.0) / 0.02))
    assert "after 44.4 ms" in texts(curves.force(t, f, 3.0, settling=0.0444))
    assert "reference" not in texts(curves.force(t, f))
    curves.force([], [])


def test_estimates_state_their_exaggeration(case: SimpleNamespace) -> None:
    truth, found = case.skin(), case.calibration()
    found.poses[:] = truth.poses
    found.poses[:, 0, 3] += 1e-6
    shown = texts(maps.estimates(ReportData(found, truth=truth)))
    assert "error × 1\u00a0000" in shown
    assert "no estimate" not in shown
    found.poses[5] = np.nan
    assert "no estimate" in texts(maps.estimates(ReportData(found, truth=truth)))


def test_iterations_give_first_middle_and_last_with_their_mean_error(case: SimpleNamespace) -> None:
    truth, plane = case.skin().positions, ReportData(case.calibration(), truth=case.skin()).plane
    steps = truth[None] + np.array([9e-3, 5e-3, 3e-3, 2e-3, 1e-3])[:, None, None] * [0.0, 0.0, 1.0]
    run = Iterations(steps, truth, True, False)
    figure = maps.iterations(run, plane)
    assert [a.get_title(loc="left") for a in figure.axes] == [
        "Iteration 0: mean 9.00 mm off",
        "Iteration 1: mean 5.00 mm off",
        "Iteration 4: mean 1.00 mm off",
    ]
    assert representative_iterations(steps[:1]) == (0, 0, 0)


def test_panels_of_a_figure_are_files_of_their_own(tmp_path: Path) -> None:
    figure = theme.new_figure(6.0, 2.0)
    for k in range(3):
        theme.add_axes(figure, 0.5 + 2.0 * k, 0.5, 1.2, 1.2).set_title(f"panel {k}")
    whole = Image.open(theme.save(figure, tmp_path, "whole")[0])
    paths = theme.save_panels(figure, tmp_path, ["a", "b", "c"])
    assert [p.name for p in paths] == ["a.png", "a.svg", "b.png", "b.svg", "c.png", "c.svg"]
    panels = [np.asarray(Image.open(p)) for p in paths[::2]]
    np.testing.assert_array_equal(np.hstack(panels), np.asarray(whole))
    for k, path in enumerate(paths[1::2]):
        text = path.read_text()
        assert [other for other in range(3) if f"<!-- panel {other} -->" in text] == [k]
        assert 'width="144pt"' in text


def test_errors_count_every_taxel_once_and_mark_the_bound() -> None:
    rng = np.random.default_rng(1)
    rows = {"joint": 1e-5 * rng.random(80), "three circles": 1e-3 * rng.random(80)}
    rows["joint"][:2] = np.nan
    figure = curves.errors(rows, 4.2e-6)
    (axes,) = figure.axes
    (upper, lower), (low, high) = (p.get_data() for p in axes.patches), axes.get_ylim()
    counts = [np.sum(row.values - row.baseline) for row in (upper, lower)]
    np.testing.assert_allclose(counts, [78, 80])
    assert low == lower.baseline < lower.values.max() < upper.baseline < upper.values.max() < high
    assert "Cramér-Rao bound 0.00420 mm" in texts(figure)
    curves.errors({"exact": np.zeros(5)})
    curves.errors({"nothing": np.full(5, np.nan)}, np.nan)


def test_coverage_crosses_out_what_was_never_touched(case: SimpleNamespace) -> None:
    found = case.calibration()
    found.readings[:] = 9
    data = ReportData(found, truth=case.skin())
    assert "never touched" not in texts(maps.coverage(data))
    found.readings[3] = 0
    assert "never touched" in texts(maps.coverage(replace(data, recording=case.recording())))
    # without a truth, nothing tells where an untouched taxel is
    assert "never touched" not in texts(maps.coverage(ReportData(found)))


def test_a_long_contact_path_takes_little_room(case, tmp_path):
    """The marks of its contacts, of which each would be an element of the SVG, are pixels."""
    data = ReportData(case.calibration(), recording=case.recording())
    assert len(data.recording.time) > maps.RASTERIZE_ABOVE
    text = theme.save(maps.coverage(data), tmp_path, "map")[1].read_text()
    assert text.count("<use ") < maps.RASTERIZE_ABOVE
    assert "<image" in text


def test_few_readings_apart_have_ticks(case):
    """90 to 170 readings have one of 1, 2, 5 in a decade."""
    found = case.calibration()
    counts = np.linspace(90, 170, len(found.ids)).astype(int)
    figure = maps.coverage(ReportData(replace(found, readings=counts)))
    bar = figure.axes[-1]
    low, high = bar.get_ylim()
    assert sum(low <= tick <= high for tick in bar.get_yticks()) >= 4


def test_ellipses_have_the_axes_of_their_covariances() -> None:
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    sigma, heading = ellipse_axes([turn @ np.diag([9.0, 4.0]) @ turn.T, np.full((2, 2), np.nan)])
    assert np.allclose(sigma[0], [3.0, 2.0])
    assert heading[0] % 180 == pytest.approx(np.degrees(np.arctan2(0.8, 0.6)))
    assert np.isnan(sigma[1]).all()


def test_uncertainty_survives_taxels_without_estimate(case: SimpleNamespace) -> None:
    c = case.calibration(sigma=2e-5)
    assert "1 sigma along the skin × 50" in texts(maps.uncertainty(ReportData(c)))
    c.poses[:], c.covariances[:] = np.nan, np.inf
    maps.uncertainty(ReportData(c))


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.01234, "0.0123"), (3.0012, "3"), (18288, "18\u00a0288"), (0.0, "0"), (-0.5, "−0.5"),
        (1.5e-9, "1.5 × 10⁻⁹"), (float("nan"), "–"), (float("inf"), "∞"), (None, "–"),
        (2e11, "2 × 10¹¹"),
    ],
)  # fmt: skip
def test_numbers_read_well(value: float | None, text: str) -> None:
    assert compact(value) == text


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.01, "0.0100"), (0.0108, "0.0108"), (0.3, "0.300"), (9.0, "9.00"), (0.00999999, "0.0100"),
        (99.96, "100"), (999.7, "1000"), (18288.0, "18\u00a0288"), (-0.5, "−0.500"), (0.0, "0"),
        (1e-9, "1.00 × 10⁻⁹"), (float("nan"), "–"),
    ],
)  # fmt: skip
def test_measured_numbers_keep_their_last_zeros(value: float, text: str) -> None:
    assert significant(value) == text


def test_names_of_settings_stay_in_their_axes(case: SimpleNamespace) -> None:
    seconds, error = (0.1, 0.5, 2.0), (0.1, 0.02, 0.05)
    names = ("trilateration", "posegraph", "posegraph_isotropic")
    figure = precision.work_precision(case.costs(names, seconds, error), ())
    figure.draw_without_rendering()
    left = figure.axes[0]
    written = [text for text in left.texts if text.get_text().replace(" ", "_") in names]
    assert len(written) == 3
    for text in written:
        assert text.get_window_extent().x1 <= left.bbox.x1 + 1.0
        assert text.get_window_extent().x0 >= left.bbox.x0 - 1.0


def test_a_line_leads_from_each_name_to_its_point() -> None:
    """Where points are close together, another one may be nearer."""
    points = {"joint": (0.31, 2e-7), "centroid": (0.28, 1e-7), "trilateration": (0.3, 2.4e-7)}
    names = {method_name(method): point for method, point in points.items()}
    figure = precision.accuracy_time(points, {"load": 1.0})
    figure.draw_without_rendering()
    left = figure.axes[0]
    for line, text in zip(left.lines[-3:], left.texts, strict=True):
        place, end = line.get_xydata()
        assert tuple(place) == pytest.approx(names[text.get_text()])
        box = text.get_window_extent().padded(2.0)
        assert box.contains(*left.transData.transform(end))


def test_names_of_estimators_that_err_alike_do_not_overlap(case: SimpleNamespace) -> None:
    names = ("trilateration", "three_circles", "posegraph", "posegraph_paper")
    costs = case.costs(names, (0.4, 0.41, 0.42, 3.0), (1e-6,) * 4)
    figure = precision.work_precision(costs, (0.1,))
    figure.draw_without_rendering()
    texts = [t.get_window_extent() for t in figure.axes[0].texts]
    assert [t.get_text() for t in figure.axes[0].texts] == [n.replace("_", " ") for n in names]
    for k, one in enumerate(texts):
        assert not any(one.overlaps(other) for other in texts[:k])


def test_names_of_estimators_cover_neither_each_other_nor_points() -> None:
    points = {
        "joint": (0.22, 0.55), "trilateration": (0.052, 1.01), "three circles": (0.039, 1.08),
        "pose graph": (1.231, 1.0), "pose graph, isotropic": (1.178, 1.1), "paper": (1.114, 3.7),
        "eq15": (0.07, 1.6),
    }  # fmt: skip
    figure = precision.accuracy_time(points, {"simulate": 1.0}, 0.0095)
    figure.draw_without_rendering()
    left = figure.axes[0]
    names = set(map(method_name, points))
    boxes = [text.get_window_extent() for text in left.texts if text.get_text() in names]
    assert len(boxes) == len(points)
    for k, box in enumerate(boxes):
        assert box.x1 <= left.bbox.x1 + 1.0
        assert not any(box.overlaps(other) for other in boxes[:k])
        assert not any(box.contains(*left.transData.transform(p)) for p in points.values())


def test_a_force_that_is_lost_or_peaks_keeps_an_axis_from_zero() -> None:
    t = np.arange(0.0, 2.0, 1e-3)
    f = 3.0 * (1 - np.exp(-t / 0.02))
    f[1000:1010], f[1500] = 0.0, 125.0
    figure = curves.force(t, f, 3.0)
    assert all(axes.get_ylim()[0] >= 0.0 for axes in figure.axes)
    assert figure.axes[0].get_ylim()[1] < 10.0
    assert "Whole run, up to 125 N" in texts(figure)


def test_a_lighter_reference_at_the_end_of_a_run_has_a_step_of_its_own() -> None:
    t = np.arange(0.0, 4.0, 1e-3)
    reference = np.where(t < 3.0, 3.0, 0.75)
    figure = curves.force(t, reference * (1.0 + 0.01 * np.sin(t)), reference)
    whole, _, close = figure.axes
    assert whole.get_ylim()[1] > 3.0
    assert close.get_ylim()[0] < 3.0 < close.get_ylim()[1] < 3.1
    x, y = whole.lines[-1].get_data()
    np.testing.assert_allclose(np.interp([1.5, 2.9, 3.1], x, y), [3.0, 3.0, 0.75])


def test_no_line_is_drawn_across_a_pause() -> None:
    t = np.concatenate([np.arange(0.0, 1.0, 0.01), np.arange(5.0, 6.0, 0.01)])
    figure = curves.force(t, np.full(200, 3.0), 3.0)
    x, y = figure.axes[0].lines[0].get_data()
    across = np.flatnonzero(np.diff(np.asarray(x)) > 1.0)
    assert not len(across)
    assert np.isnan(y).any()
    line, times = path_with_breaks(np.stack([t, t, t], axis=1), t)
    assert len(line) == len(times) == 201
    assert np.isnan(line[100]).all()
    there = np.concatenate([np.arange(100.0), 500 + np.arange(100.0)])[:, None] * np.ones(3)
    assert np.isnan(path_with_breaks(there, np.arange(200.0))[0][100]).all()


def test_long_errors_and_large_ellipses_are_cut_and_counted(case: SimpleNamespace) -> None:
    truth = case.skin()
    found = case.calibration()
    poses, covariances = found.poses.copy(), found.covariances.copy()
    poses[7, :3, 3] += poses[7, :3, :2] @ [0.05, 0.0]
    covariances[10, 0, 0] = 0.05**2
    data = ReportData(replace(found, poses=poses, covariances=covariances), truth=truth)
    for figure, words in (
        (maps.estimates(data), "1 cut short"),
        (maps.uncertainty(data), "1 drawn smaller"),
    ):
        assert words in texts(figure)
        figure.draw_without_rendering()
        axes = figure.axes[0]
        for drawn in axes.collections:
            if hasattr(drawn, "get_segments"):
                for segment in drawn.get_segments():
                    assert axes.viewLim.padded(1e-6).count_contains(segment) == 2
    plain = ReportData(found, truth=truth)
    assert "cut short" not in texts(maps.estimates(plain))
    assert "drawn smaller" not in texts(maps.uncertainty(plain))


def test_the_view_shows_the_whole_body() -> None:
    """Every corner of the body is within the camera's angle, and some are near its edge."""
    rng = np.random.default_rng(2)
    corners = np.array([[x, y, z] for x in (0, 0.3) for y in (0, 0.05) for z in (0, 0.08)])
    skin = np.tile(np.eye(4), (20, 1, 1))
    skin[:, :3, 3] = [0.05, 0.02, 0.08] + 0.01 * rng.random((20, 3)) * [1, 1, 0]
    points, normals = skin[:, :3, 3], skin[:, :3, 2]
    layout = scene3d.layout(points, normals, np.concatenate([points, corners]))
    camera = {k: np.array(list(v.values())) for k, v in layout["scene"]["camera"].items()}
    low, high = (
        np.array([layout["scene"][f"{axis}axis"]["range"][k] for axis in "xyz"]) for k in (0, 1)
    )
    points = (1e3 * corners - (low + high) / 2) / np.max(high - low) - camera["eye"]
    ahead = camera["center"] - camera["eye"]
    ahead /= np.linalg.norm(ahead)
    up = camera["up"] - (camera["up"] @ ahead) * ahead
    up /= np.linalg.norm(up)
    depth = points @ ahead
    off = np.hypot(points @ up, points @ np.cross(ahead, up) / scene3d.WIDTH) / depth
    assert (depth > 0).all()
    assert 0.5 * scene3d.FIELD_OF_VIEW < off.max() < 1.5 * scene3d.FIELD_OF_VIEW
    assert (np.abs(points @ up) / depth < 1.001 * scene3d.FIELD_OF_VIEW).all()
    buttons = layout["updatemenus"][0]["buttons"]
    assert [b["label"] for b in buttons] == ["whole body", "skin"]


def test_the_view_shows_contacts_off_the_body_and_faces_them(case: SimpleNamespace) -> None:
    """As those of a log in another frame, whose taxels have no estimate."""
    recording, found = case.recording(), case.calibration()
    off = np.tile([0.0, -0.18, 0.0], (len(recording.points), 1))
    off[0] = [0.0, 0.0, 1e3]  # in millimetres
    values = dict(zip(("px", "py", "pz", "nx", "ny", "nz"), (*off.T, *np.sign(off).T), strict=True))
    contacts = pa.table(recording.contacts.to_pydict() | values)
    nowhere = replace(found, poses=np.full_like(found.poses, np.nan))
    log = replace(recording, contacts=contacts)
    data = ReportData(nowhere, recording=log, body=Body.sphere(0.1))
    scene = scene3d.view_3d(data, transparent=False)["layout"]["scene"]
    assert -190 < scene["yaxis"]["range"][0] < -180
    assert scene["zaxis"]["range"][1] < 120
    assert scene["camera"]["eye"]["y"] < -0.5
    assert scene["xaxis"]["nticks"] > scene["yaxis"]["nticks"] == scene3d.FEWEST_TICKS


def test_a_log_without_motion_has_its_force_alone() -> None:
    t = np.concatenate([np.arange(0.0, 1.0, 0.02), np.arange(9.0, 10.0, 0.02)])
    shown = curves.recorded_force(t, 3.0 + np.sin(t))
    assert len(shown.axes) == 1
    assert shown.axes[0].get_ylim()[0] == 0.0
    assert "within 2 %" not in texts(shown)
    assert "reference" in texts(curves.recorded_force(t, 3.0 + np.sin(t), [3.0]))


def test_estimates_that_coincide_are_drawn_in_millimetres() -> None:
    factor, short = drawn_scale(np.array([4e-3, 5e-3, 6e-3, 0.5]), 0.3 * pitch(np.zeros((4, 3))))
    assert factor == 1.0
    assert (short[:3] == 1.0).all()
    assert short[3] * 0.5 == pytest.approx(2.5 * 5.5e-3)


def test_residuals_are_drawn_in_units_of_the_median_taxel_s(case):
    """One taxel has residuals three times as large as the others', another a fault; a contact was
    put 0.3 mm along the skin's first axis from where it was, a second one nowhere."""
    c = case.calibration()
    chi2, faults = np.where(c.touched, 4.0, np.nan), np.full(len(c.ids), "", dtype=object)
    chi2[5], faults[9] = 36.0, "its readings are outlying"
    data = ReportData(replace(c, chi2=chi2, faults=faults), recording=case.recording())
    place = c.positions[c.touched][:2]
    put = place + 3e-4 * data.plane.axes[0]
    put[1] = np.nan
    validation = SimpleNamespace(points=place, localized=put)
    data = replace(data, validation=validation)
    expected = np.where(c.touched, 1.0, np.nan)
    expected[5] = 3.0
    np.testing.assert_allclose(data.residuals, expected)
    taxels, bar, contacts = maps.residuals(data).axes
    (discs,) = taxels.collections
    np.testing.assert_allclose(discs.get_array(), expected[c.touched])
    assert discs.get_clim() == (0.0, 3.0)
    ringed = discs.get_edgecolors()[:, 3] > 0
    assert np.asarray(c.ids)[c.touched][ringed].tolist() == [9]
    assert "median taxel" in bar.get_ylabel()
    line = contacts.collections[-1].get_segments()
    factor = float(texts(contacts.figure).split("put them × ")[1].split(" ")[0].replace(",", ""))
    np.testing.assert_allclose(np.diff(line[0], axis=0), [[0.3 * factor, 0.0]], atol=1e-9)
    assert len(line) == 1
    alone = maps.residuals(replace(data, validation=None))
    assert len(alone.axes) == 2


@pytest.mark.parametrize(("scale", "number"), [(1.0, "0.002"), (1e-6, "2 × 10⁻⁹")])
def test_the_numbers_of_a_color_bar_are_plain(scale: float, number: str) -> None:
    """A power of ten above the bar is overlooked, and zeros after the point are cut off."""
    figure = theme.new_figure(4.0, 3.0)
    axes = theme.add_axes(figure, 0.5, 0.5, 2.0, 2.0)
    values = axes.imshow([[scale * 1e-3, scale * 6e-3]])
    bar = theme.color_bar(figure, values, axes, "sigma (mm)")
    figure.draw_without_rendering()
    assert bar.ax.yaxis.get_offset_text().get_text() == ""
    assert number in [text.get_text() for text in bar.ax.get_yticklabels()]
