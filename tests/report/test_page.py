"""The page: one file, nothing loaded from a network, the right numbers, all text escaped."""

from __future__ import annotations

import base64
import json
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from meshskin.core.errors import OutputError, UnknownNameError
from meshskin.estimation.calibrate import CONSTANT
from meshskin.estimation.calibration import Calibration
from meshskin.estimation.cross_validation import CrossValidation
from meshskin.estimation.demonstration import Demonstration
from meshskin.estimation.uncertainty.verdict import Verdict
from meshskin.geometry.body import Body
from meshskin.report import figure_set, markup, page
from meshskin.report.advice import next_steps, outlying_taxels
from meshskin.report.data import ReportData
from meshskin.report.markup import table
from meshskin.report.sections import content
from meshskin.skin.skin import Skin


class Page(HTMLParser):
    """What a browser would load, and what it would show."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.loads: list[str] = []
        self.alts: list[str] = []
        self.tags: list[str] = []
        self.shown: list[str] = []
        self.data: dict[str, Any] = {}
        self._inside: tuple[str, str | None] = ("", None)
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.tags.append(tag)
        self._inside = (tag, given.get("id"))
        for key in ("src", "srcset", "data", "poster", "action", "background"):
            if given.get(key):
                self.loads.append(str(given[key]))
        if tag == "link" or (tag == "a" and not str(given.get("href")).startswith("#")):
            self.loads.append(str(given.get("href")))
        if tag == "img" and given.get("src"):
            self.alts.append(given.get("alt") or "")

    def handle_endtag(self, tag: str) -> None:
        self._inside = ("", None)

    def handle_data(self, data: str) -> None:
        tag, name = self._inside
        if name == "view-data":
            self.data = json.loads(data)
        elif tag == "style":
            assert "url(" not in data
            assert "@import" not in data
        elif tag != "script":
            self.shown.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.shown).split())


Written = tuple[Page, list[Path]]


@pytest.fixture(scope="module")
def body(case: SimpleNamespace) -> Body:
    return Body.sphere(radius=case.RADIUS)


def inputs(case: SimpleNamespace) -> dict[str, Any]:
    return {
        "calibration": case.calibration(),
        "recording": case.recording(),
        "truth": case.skin(),
        "comparisons": {
            "trilateration": case.calibration(2e-4, "trilateration", 1),
            "posegraph": case.calibration(7e-5, "posegraph", 2),
        },
        "metrics": case.METRICS,
        "seconds": {"load": 0.5, "simulate": 2.25},
        "provenance": {"scene": "sphere", "seed": 7, "versions": {"numpy": "2.1.0"}},
    }


def write(case: SimpleNamespace, folder: Path, body: Body | None, **changes: Any) -> Written:
    files = page.report(folder / "report.html", body=body, **(inputs(case) | changes))
    return Page(files[0]), files


def write_text(case: SimpleNamespace, folder: Path, **changes: Any) -> Page:
    """The page without its figures, which take most of the time."""
    given = inputs(case) | changes
    return Page(page.write(folder / "report.html", content(ReportData(**given), [])))


@pytest.fixture(scope="module")
def full(case: SimpleNamespace, tmp_path_factory: pytest.TempPathFactory, body: Body) -> Written:
    return write(case, tmp_path_factory.mktemp("full"), body)


@pytest.mark.deep
def test_nothing_is_loaded_from_a_network(full: Written) -> None:
    loaded = full[0].loads
    assert len(loaded) == 7
    assert all(source.startswith("data:image/") for source in loaded)
    assert "default-src 'none'" in full[1][0].read_text(encoding="utf-8")


def test_the_page_stays_small(full: Written) -> None:
    assert full[1][0].stat().st_size < 8e6


def test_every_figure_is_there_as_png_and_svg(full: Written) -> None:
    folder = full[1][0].parent
    stems = {
        "fig4_force", "fig5_estimates", "fig6-8_iterations", "fig6_iteration", "fig7_iteration",
        "fig8_iteration", "errors", "coverage", "uncertainty", "accuracy_time",
    }  # fmt: skip
    for kind in ("png", "svg"):
        assert {p.stem for p in (folder / "figures").glob(f"*.{kind}")} == stems
    listed = [p.resolve() for p in full[1]]
    assert sorted(listed) == sorted(p.resolve() for p in folder.rglob("*.*"))


def test_the_page_contains_the_numbers(full: Written) -> None:
    text = full[0].text
    for part in (
        "78 of 80 taxels were located with a mean error of 0.0123 mm, 1.02 times the Cramér-Rao",
        "rms 0.0141, max 0.0333 mm",
        "Cramér-Rao bound 0.0121 mm",
        "3.001 N",
        "settled in 44.9 ms",
        "263.16 ± 0.12 kPa (1 sigma)",
        "simulate 2.250",
        "Accuracy and time of this run",
        "estimator mean error (mm) relative to the bound seconds joint maximum likelihood",
        "0.120 trilateration",
        "versions.numpy 2.1.0",
        "trilateration 0.251 0.300 0.900",
        "pose graph 0.0871",
        "0.900 least squares over all circles",
    ):
        assert part in text, part


def test_the_total_time_is_no_stage(case: SimpleNamespace, tmp_path: Path) -> None:
    seconds = {"gather": 1.0, "joint": 2.5, "other": 0.5, "total": 4.0}
    page = write_text(case, tmp_path, seconds=seconds)
    text = " ".join(page.text.split())
    assert "longest stage: joint" in text
    assert "Time 4.00 s" in text
    assert "other 0.500 12 % all 4.000" in text


def test_a_prediction_is_compared_with_the_result(case: SimpleNamespace, tmp_path: Path) -> None:
    promise = {"asked": "0.05 mm", "setting": "25 frames/s", "error_mm": 0.02, "seconds": 4.5}
    shown = write_text(case, tmp_path, metrics=case.METRICS | {"promise": promise})
    assert (
        "Requested: 0.05 mm. The pilot run chose 25 frames/s and predicted 0.0200 mm in 4.50 s; "
        "the mean error is 0.0123 mm." in shown.text
    )


def test_a_force_that_left_its_reference_comes_after_the_verdict_alone(
    case: SimpleNamespace, tmp_path: Path
) -> None:
    force = {"departure": "the contact force left its reference: 37 N", "overshoot": 0.0}
    judged = replace(case.calibration(), verdict=Verdict("PASS"))
    changes = {"calibration": judged, "metrics": case.METRICS | {"force": force}}
    text = write_text(case, tmp_path, **changes).text
    assert "PASS. The contact force left its reference: 37 N. " in text
    assert text.index("left its reference: 37 N") < text.index("taxels were located")
    assert "no overshoot, left its reference later: see above" in text


def test_the_page_states_what_was_not_determined(full: Written) -> None:
    text = full[0].text
    assert "0 of 78 not determined: the reading of a round taxel" in text
    assert "2 of 80 taxels have no estimate (never touched): 3, 40." in text
    assert "Factors used: pressure; surface." in text
    assert "body surface" in text
    assert "Extend the contact path to taxels 3, 40" in text


def test_every_picture_has_an_alternative_text(full: Written) -> None:
    assert len(full[0].alts) == 7
    assert all(len(alt) > 20 for alt in full[0].alts)


def test_the_view_holds_truth_estimates_frames_and_ellipsoids(
    case: SimpleNamespace, full: Written, body: Body
) -> None:
    traces = full[0].data["data"]
    names = [t["name"] for t in traces]
    assert any(n.startswith("1 sigma along the skin × ") for n in names)
    assert "path of the contact" in names
    assert names.count("estimated frames (heading: by convention)") == 3

    def points(name: str) -> np.ndarray:
        trace = traces[names.index(name)]
        columns = [np.frombuffer(base64.b64decode(trace[k]["bdata"]), "<f4") for k in "xyz"]
        return np.stack(columns, axis=1)

    assert np.allclose(points("true taxels"), 1e3 * case.skin().positions, atol=1e-4)
    estimates = case.calibration().positions
    seen = np.isfinite(estimates).all(axis=1)
    assert np.allclose(points("estimated taxels"), 1e3 * estimates[seen], atol=1e-4)
    mesh = next(t for t in traces if t["name"].startswith("body"))
    assert len(base64.b64decode(mesh["i"]["bdata"])) // 4 <= 5000


@pytest.mark.deep
def test_without_truth_the_stated_uncertainty_is_given(
    case: SimpleNamespace, tmp_path: Path, body: Body
) -> None:
    shown, files = write(
        case,
        tmp_path,
        body,
        truth=None,
        metrics=None,
        comparisons={},
        recording=case.recording(False),
        calibration=replace(
            case.calibration(),
            verdict=Verdict("PASS", (), ("the mesh",)),
            undetermined=("the mesh", "the scale"),
        ),
    )
    assert "PASS, except for errors that this log cannot show (listed below)." in shown.text
    assert "Not tested: the mesh" in shown.text
    assert "Not shown by the log: the scale." in shown.text
    assert "Not shown by the log: the mesh" not in shown.text, "it stands first"
    assert "stated uncertainty is 0.0141 mm (median standard deviation)" in shown.text
    assert "There is no truth to compare with" in shown.text
    assert "position error" not in shown.text.lower()
    assert "true taxels" not in [t["name"] for t in shown.data["data"]]
    names = {p.name for p in files}
    assert {"uncertainty.svg", "coverage.png", "fig4_force.png"} <= names
    assert not {"errors.svg", "fig5_estimates.svg"} & names


@pytest.mark.deep
def test_residuals_have_a_map_where_there_is_no_truth(
    case: SimpleNamespace, tmp_path: Path, body: Body, full: Written
) -> None:
    c = case.calibration()
    chi2 = np.where(c.touched, 1.0, np.nan)
    chi2[7] = 25.0
    c = replace(c, chi2=chi2)
    shown, files = write(case, tmp_path, body, calibration=c, truth=None, comparisons={})
    assert "residuals.svg" in {p.name for p in files}
    assert "Residuals of 1 of 78 taxels are more than 2 times as large" in shown.text
    assert "median taxel's: 7 (5.00)." in shown.text
    (marks,) = (t for t in shown.data["data"] if t["name"] == "residuals")
    assert marks["visible"] == "legendonly"
    assert len(marks["text"]) == 78
    shown, files = full  # with the truth
    assert "residuals.svg" not in {p.name for p in files}
    assert "Residuals over the body" not in shown.text


def test_held_out_contacts_have_a_section(case: SimpleNamespace, tmp_path: Path) -> None:
    points = np.zeros((3, 3))
    off, nan = np.array([[3e-4, 4e-4, 0.0]]), np.full((1, 3), np.nan)
    validation = CrossValidation(
        points=points,
        localized=np.concatenate([off, off, nan]),
        centroids=np.full((3, 3), 1e-3),
        fold=np.array([0, 1, 0]),
        log_likelihood=np.array([-12.0, -6.0, 0.0]),
        readings=np.array([4, 4, 0]),
        pitch=4.2e-3,
    )
    metrics = {"cross_validation": validation.metrics()}
    text = " ".join(write_text(case, tmp_path, truth=None, metrics=metrics).text.split())
    assert "maximum likelihood 0.500 0.500" in text
    assert "centroid of the taxels that read 1.73 1.73" in text
    assert "2 of 3 contacts" in text
    assert "Taxel pitch: 4.20 mm" in text
    assert "-2.25 per reading" in text.replace("\N{MINUS SIGN}", "-")


@pytest.mark.deep
def test_a_calibration_alone_is_enough(case: SimpleNamespace, tmp_path: Path) -> None:
    c = case.calibration()
    files = page.report(tmp_path / "report.html", body=None, calibration=c)
    assert "78 of 80 taxels" in Page(files[0]).text
    assert "<h1>Skin calibration</h1>" in files[0].read_text(encoding="utf-8")
    named = content(ReportData(replace(c, frame="palm")), [])
    assert named.title == "Skin calibration: palm"
    assert page.report(tmp_path / "b.html", body=None, calibration=c, truth=case.skin())


@pytest.mark.deep
def test_the_body_is_that_of_the_belief(case: SimpleNamespace, tmp_path: Path, body: Body) -> None:
    c = case.calibration()
    known = replace(c, belief=SimpleNamespace(body=body))
    assert "body (drawn" in known.report(tmp_path / "body.html")[0].read_text(encoding="utf-8")


def test_a_misspelt_option_names_the_known_one(case: SimpleNamespace, tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match=r"option of a report 'truht'.*did you mean truth"):
        case.calibration().report(tmp_path / "report.html", truht=case.skin())


def test_one_taxel_has_no_estimate(case: SimpleNamespace, tmp_path: Path) -> None:
    c = case.calibration()
    first = int(np.flatnonzero(~c.touched)[0])
    c.reasons[first] = "fewer than three readings"
    shown = write_text(case, tmp_path, calibration=c)
    assert "1 of 80 taxels has no estimate (fewer than three readings)" in shown.text


def test_a_sentence_in_a_column_of_numbers_wraps() -> None:
    html = table(("metric", "value"), [("a", "0.012"), ("b", "the model fits: " * 4)], numeric=(1,))
    assert "<td class=number>0.012</td>" in html
    assert "<td>the model fits" in html


def test_every_method_has_its_own_color() -> None:
    from meshskin.pipeline import METHODS
    from meshskin.report import theme

    assert {"joint", *METHODS} <= theme.METHOD_COLOURS.keys()
    assert len({*theme.METHOD_COLOURS.values(), theme.WARNING}) == len(theme.METHOD_COLOURS) + 1


@pytest.mark.deep
def test_a_skin_that_was_never_touched_has_a_page(
    case: SimpleNamespace, tmp_path: Path, body: Body
) -> None:
    c = case.calibration()
    c.poses[:], c.reasons[:] = np.nan, "never touched"
    c.covariances[:], c.touched[:], c.observed[:], c.readings[:] = np.inf, False, False, 0
    assert page.report(tmp_path / "least.html", body=None, calibration=c)
    for truth in (None, case.skin()):
        shown, _ = write(
            case, tmp_path, body, calibration=c, truth=truth, metrics=None, comparisons={}
        )
        assert "80 of 80 taxels have no estimate (never touched)" in shown.text


def test_text_from_outside_is_escaped(case: SimpleNamespace, tmp_path: Path) -> None:
    evil = "<script>alert(1)</script><img src=http://example.org/x>"
    c = replace(case.calibration(), anchor=evil)
    provenance = {"scene": evil, evil: evil}
    shown = write_text(case, tmp_path, calibration=c, seconds={evil: 1.0}, provenance=provenance)
    assert shown.tags.count("script") == 3
    assert all(source.startswith("data:") for source in shown.loads)
    assert "<script>alert(1)" not in (tmp_path / "report.html").read_text(encoding="utf-8")
    assert evil in shown.text


def test_the_data_of_the_view_cannot_close_the_script_element() -> None:
    html = markup.view_3d({"data": [{"name": "</script><b>"}]}, "")
    assert html.count("</script>") == 1


def test_a_large_svg_is_inlined_as_png(tmp_path: Path) -> None:
    png, svg = tmp_path / "a.png", tmp_path / "a.svg"
    png.write_bytes(b"png")
    svg.write_bytes(b"x" * (markup.MAX_SVG_BYTES + 1))
    assert "data:image/png" in markup.saved_figure(markup.SavedFigure(png, svg, "", "", ""))


def test_an_unwritable_file_is_an_output_error(case: SimpleNamespace, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OutputError):
        page.report(tmp_path / "file" / "r.html", body=None, calibration=case.calibration())


def test_any_content_can_be_written(tmp_path: Path) -> None:
    table = markup.table(("a & b", "n"), [("x < y", "1")], numeric=(1,), collapsed="more")
    tiles = [markup.tile("n", "1", "mm", "note")]
    content = markup.Content("T & t", "ok", tiles, {"S": [table]})
    path = page.write(tmp_path / "p.html", content)
    html = path.read_text(encoding="utf-8")
    assert "plotly" not in html
    assert "T & t" in Page(path).text
    assert "x < y" in Page(path).text


def collect(c: Calibration, truth: Skin | None, shown: Demonstration | None = None) -> ReportData:
    return ReportData(c, truth=truth, demonstration=shown)


def test_advice_follows_the_numbers(case: SimpleNamespace) -> None:
    chi2 = np.ones(case.COUNT)
    chi2[11] = 340.0
    readings = np.full(case.COUNT, 50)
    readings[12] = 5
    observed = np.tile([True] * 5 + [False], (case.COUNT, 1))
    observed[13, 0] = False
    changes = {"chi2": chi2, "readings": readings, "observed": observed}
    f = collect(replace(case.calibration(), **changes), case.skin())
    assert np.flatnonzero(outlying_taxels(f)).tolist() == [11]
    text = " ".join(next_steps(f))
    assert "Check taxel 11:" in text
    assert "more often (fewer than 12 readings each): 12." in text
    assert "Pass taxel 13 on both sides" in text


def test_a_constant_reading_is_a_matter_of_wiring(case: SimpleNamespace) -> None:
    reasons = np.asarray(case.calibration().reasons, dtype=object).copy()
    reasons[3] = CONSTANT
    f = collect(replace(case.calibration(), reasons=reasons), None)
    text = " ".join(next_steps(f))
    assert "Check the wiring of taxel 3: the same reading all the time." in text
    assert "Extend the contact path to taxel 40, or" in text


def test_nothing_is_advised_about_numbers_where_no_taxel_was_located(case: SimpleNamespace) -> None:
    c = case.calibration()
    assert "headings" in " ".join(next_steps(ReportData(c)))
    c.poses[:], c.covariances[:], c.observed[:] = np.nan, np.inf, False
    text = " ".join(next_steps(ReportData(c)))
    assert "headings" not in text
    assert "simulate this body" not in text


def test_taxels_that_the_plan_leaves_out_are_not_to_be_passed(case: SimpleNamespace) -> None:
    """No advice to touch what the indenter does not fit: the reason of the plan stands there."""
    observed = np.tile([True] * 5 + [False], (case.COUNT, 1))
    observed[[13, 14], 0] = False
    readings = np.where(np.arange(case.COUNT) == 13, 3, 40)
    f = collect(replace(case.calibration(), observed=observed, readings=readings), case.skin())
    reasons = {"3": "concave", "13": "edge"}
    text = " ".join(
        next_steps(replace(f, recording=SimpleNamespace(metadata={"unreachable": reasons})))
    )
    assert "The plan does not reach taxel 3 (concave): try a smaller indenter" in text
    assert "The plan does not reach taxel 13 (edge)" in text
    assert "more often" not in text
    assert "Pass taxel 14 on both sides" in text
    assert "Extend the contact path to taxel 40" in text
    lost = {"13": "given up: the contact ran over an edge of the body; round the edge"}
    text = " ".join(
        next_steps(replace(f, recording=SimpleNamespace(metadata={"unreachable": lost})))
    )
    assert (
        "The run lost the contacts of taxel 13: the contact ran over an edge of the body; round "
        "the edge." in text
    )


def test_truth_is_matched_by_id(case: SimpleNamespace) -> None:
    c = case.calibration(sigma=0.0)
    order = np.random.default_rng(0).permutation(case.COUNT)
    truth = case.skin()
    shuffled = type(truth)(truth.poses[order], truth.ids[order])
    f = collect(c, shuffled)
    assert np.nanmax(f.errors["joint"]) < 1e-15
    assert tuple(np.flatnonzero(np.isnan(f.errors["joint"]))) == case.UNTOUCHED
    assert f.true_poses is not None
    assert np.array_equal(f.true_poses, truth.poses)


def test_errors_of_a_pose_graph_are_after_rigid_alignment(case: SimpleNamespace) -> None:
    turn = np.array([[0.0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
    for method, expected in (("posegraph", 0.0), ("trilateration", 3.0)):
        c = case.calibration(sigma=0.0, method=method)
        moved = collect(replace(c, poses=turn @ c.poses), case.skin())
        assert np.nanmin(moved.errors[method]) == pytest.approx(expected, abs=1.0)
        assert (np.nanmax(moved.errors[method]) < 1e-12) == (method == "posegraph")


def test_iterations_come_from_the_demonstration_or_a_pose_graph(case: SimpleNamespace) -> None:
    joint, graph = case.calibration(), case.calibration(method="posegraph")
    assert collect(joint, case.skin()).iterations is None
    found = collect(graph, None).iterations
    assert found is not None
    assert not found.has_truth
    shown = Demonstration(np.zeros((3, 3)), np.ones((2, 3, 3)), np.arange(3))
    found = collect(graph, None, shown).iterations
    assert found is not None
    assert found.is_demonstration
    assert found.reference is shown.truth


@pytest.mark.parametrize(("nees", "said"), [(2.0, ""), (3.5, "too small"), (0.5, "too large")])
def test_a_wrong_uncertainty_is_reported(case: SimpleNamespace, nees: float, said: str) -> None:
    c, truth = case.calibration(), case.skin()
    found = replace(collect(c, truth), metrics={"nees": nees})
    text = " ".join(next_steps(found))
    assert ("is outside its 95 % band" in text) == bool(said)
    assert said in text


def test_noiseless_data_need_no_advice_about_noise(case: SimpleNamespace) -> None:
    found = collect(case.calibration(sigma=1e-10), case.skin())
    assert "almost no noise" in " ".join(next_steps(found))
    found = replace(found, metrics={"nees": 2.6, "nees_band": [1.6, 2.5], "taxels": 80})
    numbers = " ".join(content(found, ()).sections["Numbers"])
    assert "taxels" in numbers
    assert "nees" not in numbers  # errors of arithmetic do not follow the stated variance
    assert "To halve" not in " ".join(next_steps(found))


@pytest.mark.deep
def test_figures_drawn_in_two_processes_are_those_of_one(
    case: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(figure_set, "DRAWN", (figure_set.uncertainty, figure_set.coverage))
    data, steps = ReportData(case.calibration()), list[tuple[int, int]]()
    one, _ = figure_set.draw_figures(tmp_path / "one", data, None)
    two, left_out = figure_set.draw_figures(
        tmp_path / "two", data, lambda _, *done: steps.append(done), beside=True
    )
    assert [picture.title for picture in one] == [picture.title for picture in two]
    assert not left_out
    assert steps[-1] == (2, 2)
    for here, there in zip(one, two, strict=True):
        assert [a.read_bytes() for a in here.files] == [b.read_bytes() for b in there.files]
