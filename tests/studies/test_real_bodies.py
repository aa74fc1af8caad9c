"""The study of real bodies on a few taxels of one of them; skips where the meshes are absent."""

import pytest

from ..real_data import DATA, needs_ur3e


@pytest.fixture
def study(script):
    return script("real_bodies")


@pytest.mark.slow
@needs_ur3e
def test_taxels_on_the_ur3e_are_found_to_their_bound(study, monkeypatch, tmp_path):
    def few(data, full):
        body, skin = study.ur3e(data, full)
        keep = skin.ids < 40
        return body, study.ms.Skin(skin.poses[keep], skin.ids[keep], skin.disc_radius)

    monkeypatch.setitem(study.BODIES, "UR3e forearm", few)
    row, drawn = study.measure_body("UR3e forearm", DATA)
    assert row["taxels"] == 40
    assert row["found"] >= 0.9 * row["reached"] > 20
    assert row["reached"] + sum(row["not_reached"].values()) == 40
    assert row["ratio"] < study.BOUND
    assert "reached" in study.row_text(row)
    study.draw_bodies({"UR3e forearm": drawn}, tmp_path)
    assert (tmp_path / "real_bodies.png").stat().st_size > 10_000


def test_meshes_of_the_wheel_are_found(study):
    files = study.wheel_meshes()
    if not files:
        pytest.skip("example-robot-data is not installed (extra: robots)")
    assert len(files) > 100
    assert all(file.is_file() for file in files)
