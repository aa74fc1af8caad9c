"""Contacts in tables whose columns are named as people name them."""

import numpy as np
import pytest

import meshskin as ms
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
        ("px py pz cx cy cz", "", ""),
        ("px_mm py_mm pz_mm force fz", "px_mm py_mm pz_mm", "mm"),
    ],
)  # fmt: skip
def test_columns_are_found_by_their_names(names, columns, unit):
    assert contact_columns(names.split()) == (columns.split(), unit)


def test_a_log_of_contacts_and_counts_is_read_without_a_map_by_hand(tmp_path):
    import pyarrow as pa
    from pyarrow import csv, parquet

    time = 1e9 + np.arange(400) / 50
    pressed = np.sin(np.arange(400) / 10) > 0.7
    count = 40.0 + 200 * pressed[:, None] * np.linspace(0.5, 1, 5)
    count += np.random.default_rng(0).normal(size=count.shape)
    place = {f"contact_{axis}_mm": np.full(400, k) for k, axis in enumerate("xyz", 5)}
    table = {"timestamp": time, **place, "Fz": np.full(400, 4.0)}
    csv.write_csv(pa.table(table), tmp_path / "touches.csv")
    columns = {f"taxel_{k:02d}": count[:, k] for k in range(5)}
    parquet.write_table(pa.table({"timestamp": time, **columns}), tmp_path / "skin.parquet")
    _, could = read_and_suggest(tmp_path)
    log_map = ms.LogMap(tuple(found[0] for found in could.values()))
    assert {one.kind for one in log_map.streams} == {"contacts", "taxels"}
    log = ms.read_log(tmp_path, log_map)
    recording = recording_from_log(log, log_map, ms.log_frames(log, log_map))
    np.testing.assert_allclose(recording.points, [[5e-3, 6e-3, 7e-3]] * len(recording.points))
    np.testing.assert_allclose(recording.force, 4.0)
    assert len(recording.points) > 0.8 * pressed.sum()
