"""The study of link meshes: a mesh that works, one that is refused, and a taxel that is wrong."""

import json

import pytest
import trimesh


@pytest.fixture
def study(script):
    return script("link_meshes")


@pytest.mark.deep
def test_meshes_are_calibrated_or_refused(study, monkeypatch, tmp_path, capsys):
    trimesh.creation.icosphere(subdivisions=4, radius=80.0).export(tmp_path / "ball.obj")
    trimesh.creation.icosphere(subdivisions=4, radius=0.001).export(tmp_path / "tiny.STL")
    (tmp_path / "notes.txt").write_text("no mesh")
    monkeypatch.setattr(study, "TAXELS", 12)
    out = tmp_path / "links.jsonl"
    monkeypatch.setattr("sys.argv", ["link_meshes", str(tmp_path), "--out", str(out)])
    assert study.main() == 0
    ball, tiny = (json.loads(text) for text in out.read_text().splitlines())
    assert ball["found"] == 12
    assert ball["rms_mm"] < 0.05
    assert ball["verdict"] == "PASS"
    assert "extent" in tiny["refused"]
    assert "12 taxels on 2 skins, 0 confidently wrong" in capsys.readouterr().out
    monkeypatch.setattr(study, "row", None)  # a repeated call computes nothing again
    assert study.main() == 0
    assert "PASS: 1 skins, 12 taxels, 0 wrong" in capsys.readouterr().out
    assert len(out.read_text().splitlines()) == 2
    assert out.with_suffix(".png").is_file()


def test_a_crash_is_told_and_counted(study, monkeypatch, tmp_path):
    trimesh.creation.icosphere(subdivisions=4, radius=80.0).export(tmp_path / "ball.stl")
    monkeypatch.setattr(study, "plan_exploration", lambda scene: 1 / 0)
    rows = study.run([tmp_path / "ball.stl"], range(1, 2), tmp_path / "links.jsonl")
    assert "ZeroDivisionError" in rows[0]["crash"]
    assert study.is_defect(rows[0])
    assert "crash: 1 skins, 0 taxels" in study.summary(rows)


@pytest.mark.deep
def test_a_wrong_taxel_is_counted(study, monkeypatch, tmp_path):
    trimesh.creation.icosphere(subdivisions=4, radius=80.0).export(tmp_path / "ball.stl")
    monkeypatch.setattr(study, "TAXELS", 12)
    monkeypatch.setattr(study, "ERROR", 0.0)
    monkeypatch.setattr(study, "SIGMAS", 0.0)
    assert len(study.row(tmp_path / "ball.stl", 1)["wrong"]) == 12
