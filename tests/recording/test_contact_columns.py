"""Contacts in tables whose columns are named as people name them."""

import numpy as np
import pytest

import meshskin as ms
from meshskin.core.errors import RecordingError
from meshskin.recording.from_log import recording_from_log
from meshskin.recording.readers import read_and_suggest
from meshskin.recording.readers.contact_columns import contact_columns


@pytest.mark.parametrize(
    ("names", "columns", "unit"),
    [
        ("time px py pz force", "px py pz force", ""),
        ("x_mm y_mm z_mm Fz", "x_mm y_mm z_mm Fz", "mm"),
        ("contact_x contact_y contact_z nx ny nz f_n", "contact_x contact_y contact_z nx ny nz f_n",
         ""),
        ("pos.x pos.y pos.z normal_force_N", "pos.x pos.y pos.z normal_force_N", ""),
        ("px py pz fx fy fz", "px py pz", ""),
        ("vx vy vz force", "", ""),
        ("px py force", "", ""),
        ("pen_x_mm pen_y_mm pen_z_mm push_N cell00", "pen_x_mm pen_y_mm pen_z_mm push_N", "mm"),
        ("tip_x_m tip_y_m tip_z_m f_x_N f_y_N f_z_N", "tip_x_m tip_y_m tip_z_m", "m"),
        ("tip_x tip_y tip_z push_N", "", ""),
        ("tip_x_mm tip_y_mm tip_z_mm base_x_mm base_y_mm base_z_mm", "", ""),
        ("px py pz tip_x_mm tip_y_mm tip_z_mm", "px py pz", ""),
        ("px py pz cx cy cz", "", ""),
        ("px_mm py_mm pz_mm force fz", "px_mm py_mm pz_mm", "mm"),
    ],
)  # fmt: skip
def test_columns_are_found_by_their_names(names, columns, unit):
    assert contact_columns(names.split()) == (columns.split(), unit)


def read(folder, force):
    """A log of counts and of contacts, of force(pressed), and the map that is suggested for it."""
    import pyarrow as pa
    from pyarrow import csv, parquet

    time = 1e9 + np.arange(400) / 50
    pressed = np.sin(np.arange(400) / 10) > 0.7
    count = 40.0 + 200 * pressed[:, None] * np.linspace(0.5, 1, 5)
    count += np.random.default_rng(0).normal(size=count.shape)
    place = {f"contact_{axis}_mm": np.full(400, k) for k, axis in enumerate("xyz", 5)}
    csv.write_csv(
        pa.table({"timestamp": time, **place, "Fz": force(pressed)}), folder / "touches.csv"
    )
    columns = {f"taxel_{k:02d}": count[:, k] for k in range(5)}
    parquet.write_table(pa.table({"timestamp": time, **columns}), folder / "skin.parquet")
    _, could = read_and_suggest(folder)
    log_map = ms.LogMap(tuple(found[0] for found in could.values()))
    return ms.read_log(folder, log_map), log_map, pressed


def test_a_log_of_contacts_and_counts_is_read_without_a_map_by_hand(tmp_path):
    log, log_map, pressed = read(tmp_path, lambda pressed: 4.0 * pressed)
    assert {one.kind for one in log_map.streams} == {"contacts", "taxels"}
    frames = ms.log_frames(log, log_map)
    assert not any("subtract this level" in note for note in frames.notes)
    recording = recording_from_log(log, log_map, frames)
    np.testing.assert_allclose(recording.points, [[5e-3, 6e-3, 7e-3]] * len(recording.points))
    np.testing.assert_allclose(recording.force, 4.0)
    assert len(recording.points) > 0.8 * pressed.sum()


def test_contacts_where_no_taxel_answers_are_said_and_do_not_count_as_noise(tmp_path):
    noise = 0.05 * np.random.default_rng(1).normal(size=400)
    log, log_map, pressed = read(tmp_path, lambda pressed: 4.0 + 2.0 * pressed + noise)
    frames = ms.log_frames(log, log_map)
    assert "force of touches/contacts is 4 N in the median of" in frames.notes[-1]
    assert "subtract this level" in frames.notes[-1]
    assert len(recording_from_log(log, log_map, frames).points) > 0.8 * pressed.sum()


def test_forces_of_the_wrong_sign_are_named(tmp_path):
    log, log_map, _ = read(tmp_path, lambda pressed: -4.0 * pressed - 1e-3)
    frames = ms.log_frames(log, log_map)
    with pytest.raises(RecordingError, match="all contact forces of the log are negative, got -4"):
        recording_from_log(log, log_map, frames)


@pytest.mark.parametrize("points", ["", "px py pz force"])
def test_a_column_that_is_named_contacts_is_no_group_of_them(tmp_path, points):
    names = ["time", "q_1", "q_2", *points.split(), "contacts", *(f"taxel_{k}" for k in range(5))]
    rows = [",".join(names), *(",".join([str(k), *"1" * (len(names) - 1)]) for k in range(4))]
    (tmp_path / "log.csv").write_text("\n".join(rows) + "\n")
    _, could = read_and_suggest(tmp_path / "log.csv")
    log_map = ms.LogMap(tuple(found[0] for found in could.values() if found))
    kinds = {one.kind: one.length for one in log_map.streams}
    assert kinds == {"joints": None, "taxels": 5} | ({"contacts": 4} if points else {})
    assert len(ms.read_log(tmp_path / "log.csv", log_map).streams) == len(kinds)
