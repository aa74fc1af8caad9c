"""Recordings round-trip, are complete or absent, and are refused with the reason."""

import numpy as np
import pyarrow as pa
import pytest

from meshskin.core.errors import OutputError, RecordingError, UnknownNameError
from meshskin.recording.recording import CONTACT_SCHEMA, READING_SCHEMA, Recording
from meshskin.recording.recording_files import RecordingWriter, part_path

READINGS_CSV = "time,taxel,pressure\n0,1,2\n"


def tables(times=(0.0, 0.1, 0.2), read=(0.0, 0.2, 0.2)):
    n = len(times)
    contacts = pa.table([np.array(times), *np.arange(7.0 * n).reshape(7, n)], schema=CONTACT_SCHEMA)
    readings = pa.table(
        [np.array(read), np.arange(len(read), dtype=np.int32), np.ones(len(read))],
        schema=READING_SCHEMA,
    )
    return contacts, readings


def test_round_trip(tmp_path):
    contacts, readings = tables()
    Recording(contacts, readings, {"scene": "x", "taxel_ids": [0, 1, 2]}).save(tmp_path / "r")
    back = Recording.load(tmp_path / "r")
    assert back.contacts.equals(contacts)
    assert back.readings.equals(readings)
    assert back.metadata == {"scene": "x", "taxel_ids": [0, 1, 2]}
    np.testing.assert_array_equal(back.reading_contact, [0, 2, 2])
    assert back.points.shape == (3, 3)


@pytest.mark.parametrize("path", [".", "recording.readings.parquet", "recording"])
def test_a_run_s_folder_and_each_of_the_files_name_the_recording(tmp_path, path):
    recording = Recording(*tables(), {})
    recording.save(tmp_path / "recording")
    assert Recording.load(tmp_path / path).contacts.equals(recording.contacts)


def test_streaming_equals_saving_at_once(tmp_path):
    contacts, readings = tables()
    with RecordingWriter(tmp_path / "s", {"scene": "x"}) as writer:
        writer.write(contacts=contacts.slice(0, 2), readings=readings.slice(0, 1))
        writer.write(contacts=contacts.slice(2), readings=readings.slice(1))
    assert Recording.load(tmp_path / "s").contacts.equals(contacts)
    assert Recording.load(tmp_path / "s").readings.equals(readings)


def test_an_interruption_keeps_the_files_that_were_there(tmp_path):
    contacts, readings = tables()
    Recording(contacts, readings, {"run": 1}).save(tmp_path / "r")
    before = sorted(tmp_path.iterdir())
    with (
        pytest.raises(KeyboardInterrupt),
        RecordingWriter(tmp_path / "r", {"run": 2}) as writer,
    ):
        writer.write(contacts=contacts, readings=readings)
        raise KeyboardInterrupt
    assert sorted(tmp_path.iterdir()) == before
    assert Recording.load(tmp_path / "r").metadata == {"run": 1}


def test_tables_of_two_recordings_do_not_mix(tmp_path):
    contacts, readings = tables()
    Recording(contacts, readings, {}).save(tmp_path / "a")
    Recording(contacts, readings, {}).save(tmp_path / "b")
    part_path(tmp_path / "b", "readings").replace(part_path(tmp_path / "a", "readings"))
    with pytest.raises(RecordingError, match="different recordings"):
        Recording.load(tmp_path / "a")


def test_a_damaged_table_is_named(tmp_path):
    contacts, readings = tables()
    Recording(contacts, readings, {}).save(tmp_path / "r")
    file = part_path(tmp_path / "r", "contacts")
    file.write_bytes(file.read_bytes()[:200])
    with pytest.raises(RecordingError, match=r"r.contacts.parquet cannot be read"):
        Recording.load(tmp_path / "r")


def test_inconsistent_tables_are_refused(tmp_path):
    with pytest.raises(RecordingError, match=r"contacts\.parquet is missing"):
        Recording.load(tmp_path / "nothing")
    contacts, readings = tables(read=(0.0, 0.15, 0.2))
    with pytest.raises(RecordingError, match=r"no contact at its time, got 0.15 s"):
        _ = Recording(contacts, readings, {}).reading_contact
    _, late = tables(read=(0.004, 0.104, 0.196))
    shifted = Recording(contacts, late, {})
    assert shifted.reading_contact.tolist() == [0, 1, 2]
    assert np.allclose(shifted.time_lag, [0.004, 0.004, -0.004])
    with pytest.raises(RecordingError, match="must increase"):
        Recording(*tables(times=(0.0, 0.2, 0.1)), {})
    with pytest.raises(RecordingError, match="lacks force"):
        Recording(contacts.drop_columns(["force"]), readings, {})


def test_a_folder_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot write"):
        Recording(*tables(), {}).save(tmp_path / "file" / "r")


def test_headings(tmp_path):
    contacts, readings = tables()
    assert Recording(contacts, readings, {}).headings is None
    half = np.sqrt(0.5)
    columns = {"qw": half, "qx": 0.0, "qy": 0.0, "qz": half}
    turned = contacts
    for name, value in columns.items():
        turned = turned.append_column(name, pa.array(np.full(3, value)))
    Recording(turned, readings, {}).save(tmp_path / "r")
    found = Recording.load(tmp_path / "r").headings
    assert np.allclose(found, [[[0, -1, 0], [1, 0, 0], [0, 0, 1]]] * 3)
    bent = turned.set_column(8, "qw", pa.array([half, half, 1.0]))
    with pytest.raises(RecordingError, match=r"must be unit quaternions.*row 2 of contacts"):
        _ = Recording(bent, readings, {}).headings


def test_logs_in_csv(tmp_path):
    (tmp_path / "contacts.csv").write_text(
        "time_ms,px_mm,py_mm,pz_mm,force,qw,qx,qy,qz\n0,1,2,3,2.5,1,0,0,0\n10,4,5,6,3,1,0,0,0\n"
    )
    (tmp_path / "readings.csv").write_text("time_ms,taxel,pressure_kPa\n10,7,1.5\n10,8,2\n")
    log = Recording.load(tmp_path)
    assert np.allclose(log.time, [0, 0.01])
    assert np.allclose(log.points, [[1e-3, 2e-3, 3e-3], [4e-3, 5e-3, 6e-3]])
    assert np.allclose(log.force, [2.5, 3.0])
    assert np.isnan(log.normals).all()
    assert np.allclose(log.headings, np.eye(3))
    assert list(log.reading_taxel) == [7, 8]
    assert list(log.reading_contact) == [1, 1]
    assert np.allclose(log.pressure, [1500.0, 2000.0])
    for part in ("contacts", "readings"):
        (tmp_path / f"{part}.csv").rename(tmp_path / f"arm.{part}.csv")
    assert np.array_equal(Recording.load(tmp_path / "arm").points, log.points)


@pytest.mark.parametrize("column", ["px_kpa", "force_mm", "time_mpa", "nx_mm", "qw_s"])
def test_a_column_has_a_unit_of_its_quantity(tmp_path, column):
    names = {"time": 0.0, "px": 1.0, "py": 2.0, "pz": 3.0, "force": 2.5, "nx": 1.0, "qw": 1.0}
    names[column] = names.pop(column.partition("_")[0])
    names["depth_mm"] = 1.0  # of which nothing is read
    write_log(tmp_path, f"{','.join(names)}\n{','.join(map(str, names.values()))}\n")
    with pytest.raises(RecordingError, match=f"unknown unit or occurs twice, got {column}"):
        Recording.load(tmp_path)


def test_a_recording_without_contacts():
    contacts, readings = tables()
    empty = Recording(contacts[:0], readings, {})
    assert np.isnan(empty.time_lag).all()
    assert len(empty.time_lag) == 3
    with pytest.raises(RecordingError, match="a reading has no contact"):
        _ = empty.reading_contact
    with pytest.raises(RecordingError, match="no contacts to draw"):
        empty.plot()


def test_half_a_log_is_named(tmp_path):
    (tmp_path / "contacts.csv").write_text("time,px,py,pz,force\n0,1,2,3,2.5\n")
    with pytest.raises(RecordingError, match=r"readings.csv is missing; put it beside"):
        Recording.load(tmp_path)


def test_headers_may_have_blanks_and_capitals(tmp_path):
    (tmp_path / "contacts.csv").write_text("Time, PX_mm, py, pz, Force\n0,1,2,3,2.5\n")
    (tmp_path / "readings.csv").write_text("time, taxel ,Pressure_kPa\n0,1,2\n")
    log = Recording.load(tmp_path)
    assert log.points.tolist() == [[1e-3, 2.0, 3.0]]
    assert log.pressure.tolist() == [2000.0]


@pytest.mark.parametrize(
    ("readings", "words"),
    [
        ("time,taxel,pressure_psi\n0,1,2\n", "unknown unit or occurs twice, got pressure_psi.*kpa"),
        (
            "time,taxel,pressure,pressure_kpa\n0,1,2,3\n",
            "occurs twice, got pressure_kpa",
        ),
        (
            "time,taxel,pressure\n0,1,2\n0,2,soft\n",
            "numbers, got pressure = soft in row 1",
        ),
        ("time;taxel;pressure\n0;1;2\n", "separated by commas"),
        ("time,taxel,pressure\n0,1,2\n0,2.5,2\n", "must be a whole number, got 2.5 in row 1"),
        ("time,taxel,pressure\n0,,2\n", "must be a whole number, got nan in row 0"),
        ("time,taxel,pressure\n0,1\n", "cannot be read"),
        ("time,taxel,taxel,pressure\n0,1,1,2\n", "the column taxel of readings.csv occurs twice"),
        (
            "time,taxel,pressure\n0,1,-2\n",
            "got pressure = -2 in row 0, limit: at least 0",
        ),
        ("time,taxel,pressure\n0,-4,2\n", "taxel .* got taxel = -4 in row 0, limit: at least 0"),
        ("time,taxel,pressure_mPa\n0,1,2\n", "got pressure_mPa, limit: .*pressure_mpa"),
        ("time,taxel,count_ms\n0,1,2\n", "an unknown unit or occurs twice, got count_ms"),
        ("time,pressure\n0,1\n", "readings.csv lacks taxel, got columns time, pressure; it needs"),
    ],
)
def test_logs_that_cannot_be_read(tmp_path, readings, words):
    write_log(tmp_path, readings=readings)
    with pytest.raises(RecordingError, match=words):
        Recording.load(tmp_path)


@pytest.mark.parametrize("force", ["0", "-1.5"])
def test_a_force_that_is_not_positive_is_refused(tmp_path, force):
    write_log(tmp_path, f"time,px,py,pz,force\n0,1,2,3,{force}\n")
    message = rf"force of contacts.csv is out of range, got force = {force} in row 0, .* contact"
    with pytest.raises(RecordingError, match=message):
        Recording.load(tmp_path)


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-be", "latin-1"])
def test_a_log_that_is_not_in_utf_8_is_refused(tmp_path, encoding):
    write_log(tmp_path)
    mark = "\ufeff" if encoding == "utf-16-be" else ""
    text = f"{mark}time,taxel,pressure,\u00e9\n0,1,2,3\n"
    (tmp_path / "readings.csv").write_bytes(text.encode(encoding))
    with pytest.raises(RecordingError, match="UTF-"):
        Recording.load(tmp_path)


def test_taxel_ids_of_more_than_32_bits_are_kept(tmp_path):
    write_log(tmp_path, readings="time,taxel,pressure\n0,3000000000,2\n")
    assert Recording.load(tmp_path).reading_taxel.tolist() == [3000000000]


def write_log(folder, contacts="time,px,py,pz,force\n0,1,2,3,2.5\n", readings=READINGS_CSV):
    (folder / "contacts.csv").write_text(contacts)
    (folder / "readings.csv").write_text(readings)


@pytest.mark.parametrize("path", [None, 3])
def test_a_recording_is_loaded_by_its_path(path):
    with pytest.raises(RecordingError, match=f"is loaded by its path, got {path}"):
        Recording.load(path)


def test_metadata_that_json_cannot_hold_leave_no_file(tmp_path):
    with pytest.raises(RecordingError, match=r"must be JSON values: .*set"):
        Recording(*tables(), {"taxels": {1, 2}}).save(tmp_path / "r")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("column", ["reading", "Count"])
def test_a_column_of_raw_readings_may_have_any_sign(tmp_path, column):
    (tmp_path / "contacts.csv").write_text("time,px,py,pz,force\n0,1,2,3,2.5\n")
    (tmp_path / "readings.csv").write_text(f"time,taxel,{column}\n0,7,-3\n0,8,212\n")
    recording = Recording.load(tmp_path)
    assert recording.pressure.tolist() == [-3.0, 212.0]
    assert recording.metadata["readings"] == "raw"
    recording.save(tmp_path / "again")
    assert Recording.load(tmp_path / "again").metadata["readings"] == "raw"
    (tmp_path / "readings.csv").write_text("time,taxel,pressure\n0,7,3\n")
    assert "readings" not in Recording.load(tmp_path).metadata


def test_a_recording_with_other_columns():
    made = Recording(*tables(), {"scene": "x"})
    points, pressure = made.points[::-1] + 1.0, [3, 4, 5]
    other = made.with_columns(points=points, force=2 * made.force, pressure=pressure)
    np.testing.assert_array_equal(other.points, points)
    np.testing.assert_array_equal(other.force, 2 * made.force)
    np.testing.assert_array_equal(other.pressure, pressure)
    np.testing.assert_array_equal(other.normals, made.normals)
    assert other.metadata == made.metadata
    assert other.contacts.schema == made.contacts.schema
    assert made.with_columns(time=made.time) == made
    with pytest.raises(UnknownNameError, match="did you mean points"):
        made.with_columns(point=points)
    for wrong in (points[:2], points[:, 0]):
        with pytest.raises(RecordingError, match=r"wrong shape of points.*limit: \(3, 3\)"):
            made.with_columns(points=wrong)
    with pytest.raises(RecordingError, match="force must be numbers"):
        made.with_columns(force=["a", "b", "c"])
