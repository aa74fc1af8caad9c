"""CSV and Parquet files as logs: groups of columns, units of time, torn files, refusals."""

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq
import pytest

from meshskin.core.errors import MeshskinError, RecordingError, UnknownNameError
from meshskin.recording.log_map import LogMap, StreamMap
from meshskin.recording.readers import read_and_suggest, read_log

N = 50
COLUMNS = {
    "time_ms": 20.0 * np.arange(N),
    **{f"q_{k}": np.sin(k + np.arange(N)) for k in range(3)},
    **{f"skin_{k}": 200.0 + k + np.arange(N) % 7 for k in range(8)},
    "fx": np.arange(N) / 10, "fy": np.zeros(N), "fz": np.ones(N),
}  # fmt: skip


def csv(path, columns=COLUMNS):
    rows = [
        ",".join(columns),
        *(",".join(map(repr, map(float, row))) for row in zip(*columns.values(), strict=True)),
    ]
    path.write_text("\n".join(rows) + "\n")
    return path


def parquet(path, columns=COLUMNS):
    pq.write_table(pa.table(columns), path)
    return path


def test_two_streams_of_one_topic(tmp_path):
    log_map = LogMap(
        (
            StreamMap("robot", "joints", ("q_*",)),
            StreamMap("robot", "wrench", ("fx", "fy", "fz")),
            StreamMap("robot", "taxels", ("skin_*",)),
        )
    )
    log = read_log(csv(tmp_path / "log.csv"), log_map)
    assert [(s.kind, s.values.shape[1]) for s in log.streams] == [
        ("joints", 3), ("wrench", 3), ("taxels", 8),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("column", "unit", "scale"),
    [("clock", "ms", 1e3), ("clock", "ns", 1e9), ("clock", "s", 1.0), ("clock_us", "s", 1e6)],
)
def test_times_in_their_unit(tmp_path, column, unit, scale):
    """The unit in the name of a column, else that of the map."""
    times = 0.02 * np.arange(N)
    columns = {"time": np.zeros(N), column: scale * times, "shoulder_joint": np.ones(N)}
    path = csv(tmp_path / "log.csv", columns)
    given = StreamMap("shoulder_joint", "joints", time=column, time_unit=unit)
    log = read_log(path, LogMap((given,)))
    np.testing.assert_allclose(log.streams[0].times, times, atol=1e-12)


def test_a_unit_of_time_in_brackets_names_the_times(tmp_path):
    """Where no column has a usual name: Zeit [ms]."""
    times = 0.02 * np.arange(N)
    joint = {"shoulder_joint": np.ones(N)}
    for columns, name in (
        ({"Delay [ms]": 0 * times, "time_ms": 1e3 * times}, "time_ms"),
        ({"Zeit [ms]": 1e3 * times}, "Zeit [ms]"),
        ({"ms": 1e3 * times}, "ms"),
        ({"latency [ms]": np.arange(N), "[ms]": 1e3 * times}, "[ms]"),
    ):
        log, could = read_and_suggest(csv(tmp_path / "log.csv", columns | joint))
        np.testing.assert_allclose(log["joints"].times, times, atol=1e-12)
        assert could["joints"][0].kind == "joints"
        assert name not in could


@pytest.mark.parametrize(
    ("columns", "words"),
    [(("latency [ms]",), "no column of times"), (("Start [ms]", "Ende [ms]"), "several columns")],
)
def test_durations_and_two_times_are_asked_about(tmp_path, columns, words):
    """Both grow as times do."""
    path = csv(tmp_path / "log.csv", dict.fromkeys((*columns, "l_elbow"), 20.0 * np.arange(N)))
    with pytest.raises(RecordingError, match=words):
        read_and_suggest(path)
    log = read_log(path, LogMap((StreamMap("l_elbow", "joints", time=columns[-1]),)))
    assert log.streams[0].period == pytest.approx(0.02)


def test_joints_by_a_word_of_their_name(tmp_path):
    names = ("shoulder_pan_joint", "panda_joint1", "joint_2", "q", "angle_deg", "quality")
    path = csv(
        tmp_path / "log.csv",
        {"timestamp_ns": 1e9 * np.arange(N)} | dict.fromkeys(names, np.ones(N)),
    )
    log, could = read_and_suggest(path)
    assert {name: [one.names for one in could[name]] for name in could} == {
        "joints": [()], "joints_deg": [("angle",)], "quality": [],
    }  # fmt: skip
    assert could["joints"][0].values == ("shoulder_pan_joint", "panda_joint1", "joint_2", "q")
    assert log.streams[0].span == (0.0, N - 1.0)


@pytest.mark.parametrize(
    ("joints", "others"),
    [
        ("l_elbow l_shoulder_pitch torso_yaw", "l_elbow_vel elbow_torque index head_x"),
        ("shoulder_pan wrist_1 wrist_2 wrist_3", "wrist_force wrist_temperature target_q_0"),
        ("HeadYaw LShoulderPitch RElbowRoll", "LElbowCurrent"),
        ("wrist_3d_1 wrist_3d_2", "elbow_d"),
    ],
)
@pytest.mark.parametrize("unit", ["{}", "{}_deg", "{} [deg]", "{} (rad)"])
def test_joints_without_a_number_and_their_unit(tmp_path, joints, others, unit):
    """Of the iCub, of a UR and of a NAO."""
    columns = [unit.format(name) for name in joints.split()]
    table = {"Time [s]": 0.02 * np.arange(N)} | {name: np.arange(N) % 5 for name in others.split()}
    table |= {name: np.arange(N) + k for k, name in enumerate(columns)}
    path = csv(tmp_path / "log.csv", table)
    _, could = read_and_suggest(path)
    (found,) = [one for maps in could.values() for one in maps if one.kind == "joints"]
    (stream,) = read_log(path, LogMap((found,))).streams
    assert stream.fields == tuple(joints.split())
    assert stream.unit == ("deg" if "deg" in unit else "rad")
    np.testing.assert_array_equal(stream.values, np.arange(N)[:, None] + np.arange(len(columns)))


def test_columns_of_text_beside_those_of_a_map(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("time,Base [deg],state\n" + "".join(f"{k / 10},{k},idle\n" for k in range(9)))
    _, could = read_and_suggest(path)
    assert {name: len(maps) for name, maps in could.items()} == {"state": 0, "joints_deg": 1}
    (joints,) = read_log(path, LogMap((could["joints_deg"][0],))).streams
    assert joints.fields == ("Base",)


def test_units_of_numbered_columns(tmp_path):
    table = {"t [ms]": 20.0 * np.arange(N)}
    table |= {f"q{k}_deg": np.ones(N) for k in (1, 2)}
    table |= {f"skin {k} [kPa]": np.ones(N) for k in range(5)}
    table |= {f"/pad/data[{k}]": np.ones(N) for k in range(6)}
    table |= {f"F{axis} [N]": np.ones(N) for axis in "xyz"}
    _, could = read_and_suggest(csv(tmp_path / "log.csv", table))
    found = {name: (maps[0].kind, maps[0].unit, maps[0].names) for name, maps in could.items()}
    assert found == {
        "wrench": ("wrench", "", ()), "q*_deg": ("joints", "deg", ("q1", "q2")),
        "skin * [kPa]": ("taxels", "kPa", ()), "/pad/data[*]": ("taxels", "", ()),
    }  # fmt: skip
    log = read_log(tmp_path / "log.csv", LogMap(tuple(maps[0] for maps in could.values())))
    assert [stream.values.shape for stream in log.streams] == [(N, 3), (N, 2), (N, 5), (N, 6)]
    np.testing.assert_allclose(log.streams[0].times, 0.02 * np.arange(N))


@pytest.mark.parametrize(
    ("delimiter", "point", "mark"),
    [(";", ",", ""), (";", ".", ""), ("\t", ",", "# "), (" ", ".", ""), (" ", ".", "# "),
     (",", ".", "#")],
)  # fmt: skip
def test_tables_of_other_programs(tmp_path, delimiter, point, mark):
    path = csv(tmp_path / "log.csv")
    text = path.read_text().replace(",", delimiter).replace(".", point)
    path.write_text(mark + text)
    log_map = LogMap((StreamMap("skin_*", "taxels"), StreamMap("q_*", "joints")))
    taxels, joints = read_log(path, log_map).streams
    np.testing.assert_array_equal(taxels.values[:, 1], COLUMNS["skin_1"])
    np.testing.assert_array_equal(joints.values[:, 2], COLUMNS["q_2"])
    np.testing.assert_allclose(joints.times, COLUMNS["time_ms"] / 1e3)


@pytest.mark.parametrize(
    ("name", "kinds"),
    [
        ("j{}", ["joints"]), ("joints_{}", ["joints"]), ("actual_q_{}", ["joints"]),
        ("A{} [deg]", ["joints"]), ("actual_TCP_force_{}", ["wrench"]),
        ("actual_qd_{}", []), ("joint_velocity_{}", []), ("tau{}", []), ("jaw{}", ["taxels"]),
    ],
)  # fmt: skip
def test_columns_of_six_joints_are_no_taxels(tmp_path, name, kinds):
    columns = {name.format(k): 0.1 * np.arange(N) for k in range(1, 7)}
    path = csv(tmp_path / "log.csv", {"time": np.arange(N)} | columns)
    _, could = read_and_suggest(path)
    assert [one.kind for one in could[name.format("*")]] == kinds


@pytest.mark.parametrize(("write", "name"), [(csv, "log.csv"), (parquet, "log.parquet")])
def test_columns_by_group_and_by_pattern(tmp_path, write, name):
    path = write(tmp_path / name)
    log, could = read_and_suggest(path)
    assert {s.name: len(s.fields) for s in log.streams} == {
        "q_*": 3, "skin_*": 8, "wrench": 3,
    }  # fmt: skip
    kinds = [could[name][0].kind for name in ("q_*", "skin_*", "wrench")]
    assert kinds == ["joints", "taxels", "wrench"]
    log_map = LogMap(
        (
            StreamMap("q_*", "joints", names=("a", "b", "c"), unit="deg"),
            StreamMap("skin_*", "taxels", first_id=5),
            StreamMap("force", "wrench", ("f?",)),
        )
    )
    log = read_log(path, log_map)
    joints, skin, force = log.streams
    np.testing.assert_allclose(joints.times, COLUMNS["time_ms"] / 1e3)
    np.testing.assert_array_equal(joints.values[:, 1], COLUMNS["q_1"])
    assert (joints.fields, skin.fields[0]) == (("a", "b", "c"), "5")
    np.testing.assert_array_equal(skin.values[:, 7], COLUMNS["skin_7"])
    np.testing.assert_array_equal(force.values[:, 0], COLUMNS["fx"])


def test_the_columns_of_a_wrench_are_proposed_together(tmp_path):
    torque = {name: np.arange(N, dtype=float) for name in ("tx", "ty", "tz")}
    path = csv(tmp_path / "log.csv", COLUMNS | torque)
    log, could = read_and_suggest(path)
    wrench = could["wrench"][0]
    log = read_log(path, LogMap((StreamMap("skin_*", "taxels"), wrench)))
    assert log.streams[1].fields == ("fx", "fy", "fz", "tx", "ty", "tz")
    np.testing.assert_array_equal(log.streams[1].values[:, 2], COLUMNS["fz"])
    np.testing.assert_array_equal(log.streams[1].values[:, 4], torque["ty"])


def test_the_translation_of_a_pose_is_no_torque(tmp_path):
    pose = dict.fromkeys(("tx", "ty", "tz", "qx", "qy", "qz", "qw"), np.ones(N))
    log, _ = read_and_suggest(csv(tmp_path / "log.csv", COLUMNS | pose))
    assert {s.name: s.fields for s in log.streams}["wrench"] == ("fx", "fy", "fz")


def test_a_folder_of_files(tmp_path):
    csv(tmp_path / "arm.csv", {k: v for k, v in COLUMNS.items() if k[0] in "tq"})
    parquet(tmp_path / "skin.parquet", {k: v for k, v in COLUMNS.items() if k[0] in "ts"})
    log_map = LogMap((StreamMap("arm/q_*", "joints"), StreamMap("skin/skin_*", "taxels")))
    log = read_log(tmp_path, log_map)
    assert [stream.values.shape for stream in log.streams] == [(N, 3), (N, 8)]


def test_a_torn_csv_file_loses_its_last_line(tmp_path):
    path = csv(tmp_path / "log.csv")
    text = path.read_text()
    for cut in (3, 30):  # within the last number, and before some columns
        path.write_text(text[:-cut])
        log = read_log(path, LogMap((StreamMap("skin_*", "taxels"),)))
        assert len(log.streams[0]) == N - 1
        assert "last line is left out" in log.notes[0]


def test_a_torn_parquet_file_is_refused(tmp_path):
    path = parquet(tmp_path / "log.parquet")
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(RecordingError, match="torn Parquet file has lost its columns"):
        read_log(path)


@pytest.mark.parametrize(
    ("stream", "kind", "words"),
    [
        (StreamMap("skn_*", "taxels"), UnknownNameError, r"unknown group .*did you mean skin_\*"),
        (StreamMap("skin_*", "taxels", time="when"), UnknownNameError, "unknown column 'when'"),
        (StreamMap("skin_*", "taxels", ("skn*",)), UnknownNameError, "unknown column 'skn"),
        (StreamMap("skin_*", "taxels", length=9), MeshskinError, "got 8 values, limit: length = 9"),
    ],
)
def test_what_is_not_there_is_refused(tmp_path, stream, kind, words):
    with pytest.raises(kind, match=words):
        read_log(csv(tmp_path / "log.csv"), LogMap((stream,)))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a,b\n1,2\n", "has no column of times, got a, b"),
        ("no table at all", "is no log: neither a bag nor a table"),
        ("time,a_1\n0,x\n1,y\n", "must contain numbers"),
        ("time,a_1\n0,1\n1\n2\n3,4\n", "2 lines of log.csv have another number of columns"),
    ],
)
def test_what_is_no_table_is_refused(tmp_path, text, words):
    (tmp_path / "log.csv").write_text(text)
    with pytest.raises(RecordingError, match=words):
        read_log(
            tmp_path / "log.csv",
            LogMap((StreamMap("a_*", "wrench", ("a_1",)),)) if "a_1" in text else None,
        )


TAXELS = LogMap((StreamMap("skin_*", "taxels"),))


@pytest.mark.parametrize(("unit", "step"), [("s", 1), ("ms", 20), ("us", 2000), ("ns", 10**7)])
@pytest.mark.parametrize("write", ["csv", "parquet"])
def test_dates_are_times_in_s(tmp_path, write, unit, step):
    start = np.datetime64("2026-01-01T00:00:00", unit)
    stamps = start + (step * np.arange(N)).astype(f"timedelta64[{unit}]")
    table = pa.table({"stamp": stamps, "skin_1": np.arange(N), "skin_2": np.ones(N)})
    path = tmp_path / f"log.{write}"
    pq.write_table(table, path) if write == "parquet" else pa.csv.write_csv(table, path)
    (stream,) = read_log(path, TAXELS).streams
    seconds = step * np.arange(N) / {"s": 1, "ms": 1e3, "us": 1e6, "ns": 1e9}[unit]
    np.testing.assert_allclose(stream.times, 1767225600 + seconds, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("column", "times"),
    [("stamp", 1.7e12 + 20 * np.arange(N)), ("time", 20.0 * np.arange(N)),
     ("time_ms", 0.02 * np.arange(N)), ("t", 1.7e12 + 1.0 * np.arange(N))],
)  # fmt: skip
def test_times_that_cannot_be_in_their_unit_are_refused(tmp_path, column, times):
    path = parquet(tmp_path / "log.parquet", {column: times, "skin_1": np.ones(N)})
    with pytest.raises(RecordingError, match=r"times of skin_\* cannot be in m?s, .* time_unit"):
        read_log(path, TAXELS)


def test_times_that_run_backwards_have_a_remedy_that_tables_know(tmp_path):
    times = 0.02 * np.arange(N)
    path = parquet(tmp_path / "log.parquet", {"time": times[::-1], "skin_1": np.ones(N)})
    with pytest.raises(RecordingError, match="in message 1; cut the log there"):
        read_log(path, TAXELS).streams[0].check_times()


def test_rows_without_a_time_are_counted(tmp_path):
    times = 0.02 * np.arange(N)
    times[3] = np.nan
    path = parquet(tmp_path / "log.parquet", {"time": times, "skin_1": np.ones(N)})
    with pytest.raises(RecordingError, match=rf"have no time, got 1 of {N}; remove them"):
        read_log(path, TAXELS)


@pytest.mark.parametrize("first", ["0", ""])
def test_a_column_of_whole_or_missing_numbers_may_have_decimals_later(tmp_path, first):
    rows = [f"{k / 50:.2f},{first if k < 30_000 else 1.25},{'200,' * 9}200" for k in range(40_000)]
    path = tmp_path / "log.csv"
    path.write_text("\n".join(["time,skin_0," + ",".join(f"x{k}" for k in range(10)), *rows, ""]))
    assert path.stat().st_size > 1.5 * 2**20  # the first of which tells the types
    (stream,) = read_log(path, TAXELS).streams
    assert stream.values[-1, 0] == 1.25
    assert len(stream) == (40_000 if first else 10_000)  # an empty row is none of the stream


def test_names_after_spaces_and_in_quotes(tmp_path):
    path = csv(tmp_path / "log.csv")
    lines = path.read_text().splitlines()
    names = ['"skin_1, thumb"' if name == "skin_1" else name for name in lines[0].split(",")]
    spaced = [", ".join(names), *(line.replace(",", ", ") for line in lines[1:]), ""]
    path.write_text("\n".join(spaced))
    log_map = LogMap((StreamMap("skin", "taxels", ("skin_*",)), StreamMap("q_*", "joints")))
    taxels, joints = read_log(path, log_map).streams
    np.testing.assert_allclose(taxels.values[:, 1], COLUMNS["skin_1"])
    np.testing.assert_allclose(joints.values[:, 2], COLUMNS["q_2"])


def test_columns_that_occur_twice_are_refused(tmp_path):
    path = csv(tmp_path / "log.csv")
    text = path.read_text()
    path.write_text(text.replace("skin_3", "skin_2", 1))
    with pytest.raises(RecordingError, match=r"occurs twice, or the map takes .* got skin_2"):
        read_log(path, TAXELS)
    assert len(read_log(path, LogMap((StreamMap("q_*", "joints"),))).streams[0]) == N
    path.write_text(text)
    twice = LogMap((StreamMap("skin", "taxels", ("skin_*", "skin_5")),))
    with pytest.raises(RecordingError, match="got skin_5; rename it in the header, or correct"):
        read_log(path, twice)


@pytest.mark.parametrize("asked", [{"scan": True}, {"messages": "Reading.msg"}])
def test_what_is_for_bags_is_refused(tmp_path, asked):
    with pytest.raises(RecordingError, match=r"are for bags, got log.csv; leave messages="):
        read_log(csv(tmp_path / "log.csv"), **asked)


def excel(text):
    """As Excel writes a table in Germany."""
    return "sep=;\r\n" + text.replace(",", ";").replace(".", ",").replace("\n", "\r\n")


def aligned(text):
    rows = [line.split(",") for line in text.splitlines()]
    wide = [max(map(len, column)) + 2 for column in zip(*rows, strict=True)]
    lines = ["".join(map(str.rjust, row, wide)) for row in rows]
    return "\n".join(lines) + "  \n"


@pytest.mark.parametrize(
    ("make", "encoding"),
    [
        (excel, "utf-8-sig"), (excel, "latin-1"), (excel, "utf-16"), (aligned, "utf-8"),
        (lambda text: f"# log of 2026, arm 1\n# {text}", "utf-8"),
        (lambda text: f"# log of 2026, arm 1\n\n{text}\n\n", "utf-8"),
        (lambda text: '"' + text[:-1].replace(",", '";"').replace("\n", '"\n"') + '"\n', "utf-8"),
    ],
)  # fmt: skip
def test_ways_to_write_a_table(tmp_path, make, encoding):
    columns = COLUMNS | {"Kraft_größe": np.ones(N)}
    text = csv(tmp_path / "log.csv", columns).read_text(encoding="utf-8")
    (tmp_path / "log.csv").write_bytes(make(text).encode(encoding))
    log_map = LogMap((StreamMap("skin_*", "taxels"), StreamMap("q_*", "joints"),
                      StreamMap("Kraft_größe", "joints")))  # fmt: skip
    taxels, joints, last = read_log(tmp_path / "log.csv", log_map).streams
    np.testing.assert_array_equal(taxels.values[:, 1], COLUMNS["skin_1"])
    np.testing.assert_array_equal(joints.values[:, 2], COLUMNS["q_2"])
    np.testing.assert_allclose(joints.times, COLUMNS["time_ms"] / 1e3)
    assert last.values.sum() == N


@pytest.mark.parametrize(
    "header",
    ["time,0,1,2,3", "# arm 1\ntime,0,1,2,3", "# caf\x85\ntime,0,1,2,3", "% time 0 1 2 3"],
)
def test_headers_with_numbers_and_comments(tmp_path, header):
    """Columns of a table without names are numbered, as by pandas."""
    text = f"{header}\n0.0,1,2,3,4\n0.01,1,2,3,5\n"
    text = text.replace(",", " ") if "%" in header else text
    (tmp_path / "log.csv").write_bytes(text.encode("latin-1"))
    (stream,) = read_log(tmp_path / "log.csv", LogMap((StreamMap("*", "taxels"),))).streams
    np.testing.assert_array_equal(stream.values, [[1, 2, 3, 4], [1, 2, 3, 5]])


def test_a_file_that_is_torn_in_its_first_row_has_no_samples(tmp_path):
    (tmp_path / "log.csv").write_text("time,q_0,q_1\n0.0,1.0,2")
    log, _ = read_and_suggest(tmp_path / "log.csv")
    assert [len(stream) for stream in log.streams] == [0]
    assert "its last line is left out" in log.notes[0]


def test_runs_of_spaces_at_any_place_of_a_file():
    from meshskin.recording.readers.csv_file import _SingleSpaces

    text = b"  a   b \r\n 1    2\n\n   3 4  \n5 6"
    for size in (1, 2, 3, 5, 100):
        single = _SingleSpaces()
        parts = [single(text[k : k + size]) for k in range(0, len(text), size)]
        assert b"".join(parts) == b"a b\r\n1 2\n\n3 4\n5 6"


def test_decimal_commas_that_come_late(tmp_path):
    rows = "".join(f"{10 * k};{k % 3};{k % 9 if k < 9000 else '0,5'}\n" for k in range(10_000))
    (tmp_path / "log.csv").write_text(f"time_ms;q_1;q_2\n{rows}")
    (stream,) = read_log(tmp_path / "log.csv", LogMap((StreamMap("q_*", "joints"),))).streams
    assert stream.values[-1].tolist() == [0.0, 0.5]


def test_thousands_are_no_decimals(tmp_path):
    rows = "".join(f'{k / 10},"2,{k % 9}00"\n' for k in range(20))
    (tmp_path / "log.csv").write_text(f"time,q_1\n{rows}")
    with pytest.raises(RecordingError, match=r"q_1 = '2,000' in row 1; .*separators of thousands"):
        read_log(tmp_path / "log.csv", LogMap((StreamMap("joints", "joints"),)))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"PK\x03\x04", "Excel workbook.*save it as CSV"),
        (b"\x1f\x8b", "gzip; unpack"),
        (b"0.0,1.5\n0.1,1.6\n", "no header line, got '0.0,1.5'; write the names"),
        (b"time,q_1\n0,1,\n1,2,\n", "got 3 columns, limit: 2; give each column a name"),
        (b"time,q_1\n31.01.2026 10:00,1\n", "'31.01.2026 10:00' in row 1; .*or dates as"),
        (b"time,q_1\ns,rad\n0,1\n", "got time = 's' in row 1; .*or remove the row"),
    ],
)
def test_files_that_must_be_saved_anew(tmp_path, content, words):
    (tmp_path / "log.csv").write_bytes(content)
    with pytest.raises(RecordingError, match=words):
        read_and_suggest(tmp_path / "log.csv")


def test_a_unit_of_time_that_no_name_says_is_proposed(tmp_path):
    """And read so: whole nanoseconds, as of `rostopic echo -p`, whose joints are named in rows."""
    table = {"%time": 1e7 * np.arange(N) + 1.7e18, "field.header.seq": np.arange(N)}
    text = csv(tmp_path / "log.csv", table | {f"field.position{k}": np.arange(N) for k in (0, 1)})
    lines = text.read_text().splitlines()
    lines = [f"{lines[0]},field.name0,field.name1", *(f"{line},elbow,wrist" for line in lines[1:])]
    text.write_text("\n".join([*lines, ""]))
    log, could = read_and_suggest(text)
    assert log["field.position*"].rate == pytest.approx(100.0)
    (joints,) = could["field.position*"]
    assert (joints.time_unit, joints.names) == ("ns", ("elbow", "wrist"))
    (stream,) = read_log(text, LogMap((joints,))).streams
    np.testing.assert_allclose(stream.times - 1.7e9, 0.01 * np.arange(N), atol=1e-6)


def test_rows_of_other_streams_are_left_out(tmp_path):
    """PlotJuggler writes a row for each time of any series."""
    names = [f"/joint_states/{name}/position" for name in ("elbow", "wrist_1")]
    forces = [f"/ft/wrench/{part}/{axis}" for part in ("force", "torque") for axis in "xyz"]
    rows = [f"{k / 100},{k},{k},,,,,,\n{k / 100 + 0.002},,,1,2,{k},4,5,6\n" for k in range(N)]
    header = ",".join(["__time", *names, *forces])
    (tmp_path / "log.csv").write_text(f"{header}\n{''.join(rows)}")
    log, could = read_and_suggest(tmp_path / "log.csv")
    assert {stream.name: round(stream.rate) for stream in log.streams} == {
        "wrench": 100, "joints": 100,
    }  # fmt: skip
    given = LogMap((could["joints"][0], could["wrench"][0]))
    joints, wrench = read_log(tmp_path / "log.csv", given).streams
    assert joints.fields == ("elbow", "wrist_1")
    np.testing.assert_array_equal(joints.values[:, 1], np.arange(N))
    np.testing.assert_allclose(wrench.times, np.arange(N) / 100 + 0.002)
    np.testing.assert_array_equal(wrench.values[-1], [1, 2, N - 1, 4, 5, 6])


def test_rounded_times_are_refused(tmp_path):
    path = csv(tmp_path / "log.csv", {"time": np.arange(N) // 10, "skin_0": np.arange(N)})
    with pytest.raises(RecordingError, match="rounded, got 10 rows of each time in time, limit: 3"):
        read_log(path, LogMap((StreamMap("skin_0", "taxels"),)))


@pytest.mark.parametrize("kind", ["list", "fixed", "struct"])
def test_lists_and_nested_fields_of_parquet(tmp_path, kind):
    values = np.arange(3.0 * N).reshape(N, 3)
    numbers = pa.list_(pa.float32(), 3 if kind == "fixed" else -1)
    rows = [dict(zip("abc", row, strict=True)) for row in values.tolist()]
    column = pa.array(rows) if kind == "struct" else pa.array(values.tolist(), numbers)
    stamps = [{"stamp": {"sec": 5 + k // 10, "nanosec": k % 10 * 10**8}} for k in range(N)]
    path = tmp_path / "log.parquet"
    pq.write_table(pa.table({"header": pa.array(stamps), "q": column}), path)
    given = StreamMap("arm", "joints", ("q.*" if kind == "struct" else "q[[]?]",))
    (stream,) = read_log(path, LogMap((given,))).streams
    np.testing.assert_array_equal(stream.values, values)
    np.testing.assert_allclose(stream.times, 5 + np.arange(N) / 10)


def test_lists_may_be_empty_in_the_rows_of_other_streams(tmp_path):
    """More of them than are read at once."""
    lists = [[1.0, 2.0, 3.0]] * 5000 + [None] * 9000
    table = pa.table({"time": np.arange(14_000) / 100, "skin": lists})
    pq.write_table(table, tmp_path / "log.parquet")
    given = StreamMap("skin", "taxels", ("skin[[]?]",))
    (stream,) = read_log(tmp_path / "log.parquet", LogMap((given,))).streams
    np.testing.assert_array_equal(stream.values, [[1.0, 2.0, 3.0]] * 5000)
    listed, _ = read_and_suggest(tmp_path / "log.parquet")
    assert [len(one) for one in listed.streams] == [5000]


def test_lists_of_different_lengths_are_refused(tmp_path):
    table = pa.table({"time": [0.0, 0.1], "q": [[1.0], [1.0, 2.0]]})
    pq.write_table(table, tmp_path / "a.parquet")
    with pytest.raises(RecordingError, match=r"lists of q .* got 1 to 2 values; write lists"):
        read_log(tmp_path / "a.parquet")


@pytest.mark.parametrize("kind", [pa.duration("us"), pa.time64("us"), pa.timestamp("us", "UTC")])
def test_types_of_time_in_parquet(tmp_path, kind):
    times = pa.array(20_000 * np.arange(N), pa.int64()).cast(kind)
    pq.write_table(pa.table({"index": times, "skin_0": np.arange(N)}), tmp_path / "a.parquet")
    (stream,) = read_log(tmp_path / "a.parquet", TAXELS).streams
    np.testing.assert_allclose(stream.times, 0.02 * np.arange(N))


def test_columns_with_brackets_in_a_map_file(tmp_path):
    path = csv(tmp_path / "log.csv", {"time": np.arange(N) / 10, "Elbow [deg]": np.arange(N)})
    (given,) = read_and_suggest(path)[1]["joints_deg"]
    (tmp_path / "map.toml").write_text(LogMap((given,)).to_toml())
    (stream,) = read_log(path, LogMap.load(tmp_path / "map.toml")).streams
    assert (stream.fields, stream.unit) == (("Elbow",), "deg")


def test_forces_are_no_joints(tmp_path):
    given = StreamMap("wrench", "joints", ("f?",))
    with pytest.raises(RecordingError, match=r"no joints, got fx, fy, fz; write kind = .wrench.*"):
        read_log(csv(tmp_path / "log.csv"), LogMap((given,)))


def test_a_file_of_a_folder_that_is_no_log_is_left_out(tmp_path):
    csv(tmp_path / "arm.csv")
    (tmp_path / "notes.csv").write_text("robot,place\nur5,lab\n")
    log, _ = read_and_suggest(tmp_path)
    assert {stream.name.partition("/")[0] for stream in log.streams} == {"arm"}
    assert "notes.csv is left out: notes.csv has no column of times" in log.notes[0]
    assert len(read_log(tmp_path, LogMap((StreamMap("arm/q_*", "joints"),))).streams) == 1
    (tmp_path / "skin.parquet").write_bytes(b"PAR1")
    with pytest.raises(RecordingError, match=r"skin.parquet cannot be read.*torn"):
        read_log(tmp_path, LogMap((StreamMap("skin/skin_*", "taxels"),)))


def test_the_rows_of_a_list_may_be_missing(tmp_path):
    table = pa.table({"time": [0.0, 0.1, 0.2], "q": [[1.0, None], None, [3.0, 4.0]]})
    pq.write_table(table, tmp_path / "a.parquet")
    given = LogMap((StreamMap("q[*]", "joints"),))
    (stream,) = read_log(tmp_path / "a.parquet", given).streams
    np.testing.assert_array_equal(stream.values, [[1, np.nan], [3, 4]])
    np.testing.assert_array_equal(stream.times, [0.0, 0.2])
