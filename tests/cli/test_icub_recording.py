"""A real recording of the iCub, whose contacts its own taxels tell, to the report."""

import json

import numpy as np
import pyarrow.compute as pc

import meshskin as ms
from meshskin import cli
from meshskin.report import scene3d

from ..real_data import DATA, needs_icub, needs_icub_log

PORT = "/skinManager/skin_events:o/left_forearm"


def write_map(folder):
    (folder / "map.toml").write_text(
        f'[[stream]]\ntopic = "{PORT}"\nkind = "contacts"\nunit = "m"\n'
        f'[[stream]]\ntopic = "{PORT}/taxels"\nkind = "taxels"\nunit = "count"\n'
    )
    return folder / "map.toml"


@needs_icub
@needs_icub_log
def test_the_report_says_that_it_cannot_be_calibrated(tmp_path, capsys):
    body, out = DATA / "icub_body", tmp_path / "out"
    given = [DATA / "icub_recording", "--map", write_map(tmp_path), "--raw", "--open"]
    given += ["--urdf", body / "iCubGazeboV2_5.urdf", "--link", "l_forearm"]
    given += ["--folder", body / "meshes", "--indenter-radius-mm", 10, "--out", out]
    assert cli.main(["calibrate", *map(str, given)]) == 1
    printed = capsys.readouterr().out
    assert printed.startswith("verdict: FAIL\n")
    assert "computed by the robot from the taxels that answered" in printed
    assert "0 of 47 taxels determined" in printed
    assert "the contact points lie 24 mm off the surface of the body" in printed
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "computed by the robot from the taxels that answered" in page
    assert "recording · not calibrated" in page
    for absent in ("Recommendations", "meshskin cost SCENE", "point at a taxel"):
        assert absent not in page
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["verdict"]["level"] == "FAIL"
    found = ms.Calibration.load(out / "calibration")
    assert not np.isfinite(found.positions).any()
    recording = ms.Recording.load(out / "recording")
    counts = np.unique(recording.reading_taxel[recording.pressure > 0], return_counts=True)
    assert dict(zip(*counts, strict=True)) == {
        taxel: count
        for taxel, count in zip(found.ids, found.readings, strict=True)
        if count
    }  # fmt: skip
    assert found.touched.sum() > 45  # of the 47 that the file names


def test_contact_points_of_the_taxels_themselves_are_refused(noisy, noisy_recording):
    """Whatever the numbers: the metadata say where they come from."""
    metadata = noisy_recording.metadata | {"contact_points": "taxels"}
    recording = ms.Recording(noisy_recording.contacts, noisy_recording.readings, metadata)
    found = ms.calibrate(recording, noisy.belief())
    assert found.verdict.level == "FAIL"
    assert "own map" in found.verdict.reasons[0]
    assert not found.observed.any()
    assert found.readings.sum() == (noisy_recording.pressure > 0).sum()
    seen, path = (scene3d._route(noisy_recording, located) for located in (False, True))
    assert seen["marker"]["size"] > 2 * path["marker"]["size"]  # dots that can be seen
    assert not any("off the surface" in reason for reason in found.verdict.reasons)
    moved = recording.contacts
    for name in ("px", "py", "pz"):
        away = pc.multiply(moved[name], 1.2)  # from a sphere of radius 0.1 m: 20 mm
        moved = moved.set_column(moved.schema.get_field_index(name), name, away)
    recording = ms.Recording(moved, noisy_recording.readings, metadata)
    found = ms.calibrate(recording, noisy.belief())
    assert "lie 20 mm off the surface" in found.verdict.reasons[-1]


@needs_icub_log
def test_a_proposed_map_has_one_part_of_those_that_number_their_taxels_alike(tmp_path, capsys):
    path = tmp_path / "map.toml"
    assert cli.main(["init", str(DATA / "icub_recording"), "--out", str(path)]) == 0
    assert [stream.topic for stream in ms.LogMap.load(path).streams] == [PORT, f"{PORT}/taxels"]
    assert "right_forearm/taxels" in path.read_text()  # named in a comment
    assert cli.main(["log", str(DATA / "icub_recording"), "--map", str(path)]) == 0
