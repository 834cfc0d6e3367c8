"""Readings from tables and makers' files."""

import sys
from pathlib import Path

import insta360_files
import numpy as np
import pytest
from refusals import refused

from gsba.imu.files import read_imu, read_telemetry

VALUES = np.random.default_rng(0).normal(0, 0.5, (20, 6))
TIMES = 5.0 + 0.01 * np.arange(20)


def _write(path: Path, header: str, columns: np.ndarray, mark: str = ",") -> Path:
    rows = [mark.join(repr(float(value)) for value in row) for row in columns]
    path.write_text("\n".join([*([header] if header else []), *rows]) + "\n")
    return path


def _table(path: Path, header: str = "", mark: str = ",") -> Path:
    return _write(path, header, np.column_stack([TIMES, VALUES]), mark)


@pytest.mark.parametrize("mark", [",", ";", " ", "\t"])
@pytest.mark.parametrize(
    "header",
    [
        "",
        "t gyro_x gyro_y gyro_z acc_x acc_y acc_z",
        "#t gyro_x gyro_y gyro_z acc_x acc_y acc_z",
        "Time Gyro.X Gyro.Y Gyro.Z Accel.X Accel.Y Accel.Z",
        "t[s] wx[rad/s] wy[rad/s] wz[rad/s] ax[m/s²] ay[m/s^2] az[m/s2]",
    ],
)
def test_a_table_says_what_its_columns_are(tmp_path: Path, header: str, mark: str) -> None:
    found = read_imu(_table(tmp_path / "imu.csv", header.replace(" ", mark), mark))
    np.testing.assert_array_equal(found.timestamps, TIMES)
    np.testing.assert_array_equal(found.rates, VALUES[:, :3])
    np.testing.assert_array_equal(found.forces, VALUES[:, 3:])


def test_units_that_a_header_names_are_turned_into_ours(tmp_path: Path) -> None:
    header = "t [ms],gx (deg/s),gy (°/s),gz [dps],ax [g],ay [g],az [g]"
    columns = np.column_stack([1e3 * TIMES, np.rad2deg(VALUES[:, :3]), VALUES[:, 3:] / 9.80665])
    found = read_imu(_write(tmp_path / "imu.csv", header, columns))
    np.testing.assert_allclose(found.timestamps, TIMES)
    np.testing.assert_allclose(found.rates, VALUES[:, :3])
    np.testing.assert_allclose(found.forces, VALUES[:, 3:])


def test_euroc_tables_and_foreign_columns_in_any_order(tmp_path: Path) -> None:
    header = (
        "#timestamp [ns],temperature,w_RS_S_z [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_x [rad s^-1]"
    )
    columns = np.column_stack([1e9 * TIMES, 20 + TIMES, VALUES[:, 2::-1]])
    found = read_imu(_write(tmp_path / "imu.csv", header, columns))
    np.testing.assert_allclose(found.rates, VALUES[:, :3])
    np.testing.assert_allclose(found.timestamps, TIMES)
    assert found.forces is None


def test_a_remark_is_no_header(tmp_path: Path) -> None:
    path = _table(tmp_path / "imu.csv")
    path.write_text("# made by a logger, at 100 Hz, on a Monday\n" + path.read_text())
    np.testing.assert_array_equal(read_imu(path).rates, VALUES[:, :3])


def test_four_columns_are_a_gyro_alone(tmp_path: Path) -> None:
    found = read_imu(_write(tmp_path / "imu.txt", "", np.column_stack([TIMES, VALUES[:, :3]])))
    np.testing.assert_array_equal(found.rates, VALUES[:, :3])
    assert found.forces is None


LINES = [",".join(map(repr, row)) for row in np.column_stack([TIMES, VALUES]).tolist()]
NAMES = "t,gyro_x,gyro_y,gyro_z"


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        ([], "no readings"),
        ([NAMES], "no readings"),
        (LINES[:3], "at least 10"),
        ([line + ",1" for line in LINES], "imu.csv:1: 8 columns"),
        ([*LINES[:4], "1,2,3", *LINES[4:]], "imu.csv:5: 3 values where 7"),
        ([*LINES[:4], LINES[4].replace("5.04", "x"), *LINES[5:]], "imu.csv:5: 'x' is not"),
        ([*LINES[:4], "5.04,nan,1,1,1,1,1", *LINES[5:]], "imu.csv:5: 'nan' is not"),
        ([*LINES[:4], *LINES[3:]], "imu.csv:5: time 5.03 does not come after 5.03"),
        ([*LINES[:4], "5.04,57.3,1,1,1,1,1", *LINES[5:]], "imu.csv:5: 57.3 rad/s.*deg/s"),
        (["t,gyro_x,gyro_y,acc_x,acc_y,acc_z,temp", *LINES], "no column is gyro_z"),
        (["t,gyro_x,gyro_y,gyro_z,acc_x,acc_y,temp", *LINES], "no column is acc_z"),
        (["t,gyro_x,wx,gyro_y,gyro_z,b,c", *LINES], "two columns are gyro_x"),
        (["t,gyro_x [rpm],gyro_y,gyro_z,a,b,c", *LINES], "rpm.*rad/s, deg/s"),
        (["t [h],gyro_x,gyro_y,gyro_z,a,b,c", *LINES], "want one of s, sec, ms, us, ns"),
        ([f"{n},1,2,3" for n in range(20)], "a reading every 1 s.*ms"),
    ],
)
def test_bad_tables_are_refused_in_one_line(tmp_path: Path, lines: list[str], said: str) -> None:
    path = tmp_path / "imu.csv"
    path.write_text("\n".join(lines) + "\n")
    assert str(path) in refused(said, read_imu, path)


@pytest.mark.parametrize("name", ["none.csv", "none.insv"])
def test_a_missing_file_is_named(tmp_path: Path, name: str) -> None:
    refused(r"none.*cannot be read", read_imu, tmp_path / name)


def test_makers_files_are_read_by_telemetry_parser(tmp_path: Path) -> None:
    """The library itself reads a log of the layout that Gyroflow publishes."""
    pytest.importorskip("telemetry_parser", reason="needs gsba[imu]")
    whole = np.rint(1e4 * VALUES).astype(int)
    head = ["GYROFLOW IMU LOG", "version,1.3", "id,made here", "orientation,XYZ"]
    head += ["tscale,0.001", "gscale,0.0001", "ascale,0.0001", "t,gx,gy,gz,ax,ay,az"]
    rows = [",".join(map(str, [10 * n, *row])) for n, row in enumerate(whole.tolist())]
    path = tmp_path / "walk.gcsv"
    path.write_text("\n".join([*head, *rows]) + "\n")
    found = read_imu(path)
    np.testing.assert_allclose(found.timestamps, 0.01 * np.arange(20), atol=1e-12)
    np.testing.assert_allclose(found.rates, 1e-4 * whole[:, :3], atol=1e-12)
    np.testing.assert_allclose(found.forces, 9.80665e-4 * whole[:, 3:], atol=1e-9)


def test_files_of_insta360_are_read_without_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "telemetry_parser", None)
    path = tmp_path / "walk.insv"
    path.write_bytes(bytes(2000) + insta360_files.trailer(insta360_files.usual_records()))
    found = read_imu(path)
    np.testing.assert_allclose(found.timestamps, 0.001 * np.arange(500) - 0.01, atol=1e-12)
    np.testing.assert_allclose(found.rates[0], 0.5 * np.sin([0, 1, 2]), atol=6e-4)
    assert found.forces is not None
    np.testing.assert_allclose(np.linalg.norm(found.forces, axis=1), 9.80665, rtol=1e-3)


@pytest.mark.parametrize(("first_frame", "said"), [(6_000_000, "-1.010 to -0.511"), (0, "4.990")])
def test_a_gyro_of_another_recording_is_refused(
    tmp_path: Path, first_frame: int, said: str
) -> None:
    path = tmp_path / "walk.insv"
    records = insta360_files.usual_records(first_frame=first_frame)
    path.write_bytes(insta360_files.trailer(records))
    message = f"{said}.* from 0 to 1.500 s: readings of another"
    refused(message, read_telemetry, path, lasting_s=1.5)
    assert len(read_telemetry(path, lasting_s=5.0 if first_frame == 0 else None).timestamps) == 500


_PANIC = b"GYROFLOW IMU LOG\ntscale,often\nt,gx,gy,gz\n0,1,2,3\n"  # of the library


@pytest.mark.parametrize(("name", "content"), [("walk.insv", bytes(2000)), ("walk.gcsv", _PANIC)])
def test_what_telemetry_parser_cannot_read_is_named(
    tmp_path: Path, name: str, content: bytes
) -> None:
    pytest.importorskip("telemetry_parser", reason="needs gsba[imu]")
    (tmp_path / name).write_bytes(content)
    refused(f"{name}: telemetry-parser finds no gyro", read_imu, tmp_path / name)


def test_without_telemetry_parser_a_line_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "telemetry_parser", None)  # as if it were not installed
    path = tmp_path / "walk.insv"
    path.write_bytes(b"anything")
    refused(r"pip install 'gsba\[imu\]'", read_imu, path)
