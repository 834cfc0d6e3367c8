"""Trajectory files: what is read, what is refused and where, and what is written back."""

import tempfile
from pathlib import Path

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refused
from scipy.spatial.transform import Rotation

from gsba.geometry import pose
from gsba.log import GsbaError
from gsba.trajectory.files import read_trajectory, write_tum
from gsba.types import Trajectory

SHARED = Path(__file__).parents[3] / "shared" / "data"
needs_shared = pytest.mark.skipif(not SHARED.is_dir(), reason="no ../shared/data")

TUM = ["0 1 2 3 0 0 0 1", "0.5 2 2 3 0 0 0.6 0.8", "1 3 2 3 0 0 0 -1"]


def saved(tmp_path: Path, text: str, name: str = "traj.txt") -> Path:
    path = tmp_path / name
    path.write_text(text, encoding="utf-8", newline="")
    return path


def test_tum_convention(tmp_path: Path) -> None:
    trajectory = read_trajectory(saved(tmp_path, "\n".join(TUM)))
    np.testing.assert_array_equal(trajectory.timestamps, [0, 0.5, 1])
    np.testing.assert_array_equal(trajectory.world_T_rigs[1, :3, 3], [2, 2, 3])
    rotation = [[0.28, -0.96, 0], [0.96, 0.28, 0], [0, 0, 1]]  # about z, cos(a / 2) = 0.8
    np.testing.assert_allclose(trajectory.world_T_rigs[1, :3, :3], rotation, atol=1e-15)
    np.testing.assert_array_equal(trajectory.world_T_rigs[2, :3, :3], np.eye(3))  # -q is q
    np.testing.assert_array_equal(trajectory.world_T_rigs[:, 3], [[0, 0, 0, 1]] * 3)


def test_tum_comments_blanks_and_number_forms(tmp_path: Path) -> None:
    text = (
        "\ufeff# t x y z\r\n\r\n0 -0 1e-3 +3 0 0 0 1\r\n  \t\n28.3000000000001\t1 2 3 0 0 0 1.0005 "
    )
    trajectory = read_trajectory(saved(tmp_path, text))
    np.testing.assert_array_equal(trajectory.timestamps, [0, 28.3000000000001])
    np.testing.assert_array_equal(trajectory.world_T_rigs[0, :3, 3], [0, 1e-3, 3])
    np.testing.assert_allclose(trajectory.world_T_rigs[1, :3, :3], np.eye(3), atol=1e-15)


def test_tum_whole_nanoseconds(tmp_path: Path) -> None:
    text = "1403636579763555584 0 0 0 0 0 0 1\n1403636579813555456 0 0 0 0 0 0 1\n"
    times = read_trajectory(saved(tmp_path, text)).timestamps
    np.testing.assert_array_equal(times, [1403636579.763555584, 1403636579.813555456])


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("0.5 1 2 3 0 0 0", "7 values where others have 8"),
        ("0.5 1 2 3 0 0 0 1 9", "9 values where others have 8"),
        ("0.5,1,2,3,0,0,0,1", "1 values where others have 8"),
        ("1e300 1 2 3 0 0 0 1", "'1e300' is not a finite number"),
        ("0.5 1 2 " + "x" * 5000 + " 0 0 0 1", "'x+\\.\\.\\.x+' is not a number"),
        ("0.5 1 2 x 0 0 0 1", "'x' is not a number"),
        ("t 1 2 3 0 0 0 1", "'t' is not a finite number"),
        ("nan 1 2 3 0 0 0 1", "'nan' is not a finite number"),
        ("0.5 1 2 3 0 0 0 1.01", "quaternion has norm 1.01, not 1"),
        ("0.5 1 2 3 0 0 0 1e300", "quaternion has norm inf, not 1"),
        ("0 1 2 3 0 0 0 1", "timestamp 0.0 occurs twice"),
        ("-1 1 2 3 0 0 0 1", "timestamp -1.0 comes after 0.0; sort"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_refused_tum_lines(tmp_path: Path, line: str, message: str) -> None:
    path = saved(tmp_path, f"# header\n{TUM[0]}\n{line}\n{TUM[2]}\n")
    refused(rf"traj\.txt:3: {message}", read_trajectory, path)


@pytest.mark.parametrize(
    "row", ["nan nan nan nan nan nan nan", "1 2 3 0 0 0 0", "1e27 0 0 0 0 0 1", "0 inf 0 0 0 0 1"]
)
def test_rows_of_lost_frames_have_no_pose(tmp_path: Path, row: str) -> None:
    lines = [f"{n} {n} 0 0 0 0 0 1" for n in range(4)]
    trajectory = read_trajectory(saved(tmp_path, "\n".join([*lines[:2], f"2 {row}", lines[3]])))
    np.testing.assert_array_equal(trajectory.timestamps, [0, 1, 3])
    np.testing.assert_array_equal(trajectory.world_T_rigs[:, 0, 3], [0, 1, 3])
    with pytest.raises(GsbaError, match=r"traj\.txt:2: no pose .* in 2 of 3 rows; at least 2"):
        read_trajectory(saved(tmp_path, f"{lines[0]}\n1 {row}\n2 {row}\n"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "holds no poses"),
        ("# only a comment\n", "holds no poses"),
        (TUM[0], "1 poses; at least 2"),
        ("1 2 3\n", "traj.txt:1: 3 values; want 8"),
        ("1,2,3,4,0,0,0,1\n", "traj.txt:1: values separated by commas; want 8"),
        ("0,1,2,3,0,0,0,1\n", "separated by blanks"),
        ('{"frames": []}\n', "traj.txt:1: JSON, as nerfstudio's transforms.json; want 8"),
        ("1 1 0 0 0 0 0 0 1 a.jpg\n", "10 values, as in COLMAP's images.txt"),
    ],
)
def test_refused_files(tmp_path: Path, text: str, message: str) -> None:
    refused(message, read_trajectory, saved(tmp_path, text))


def test_refused_paths(tmp_path: Path) -> None:
    refused("cannot be read", read_trajectory, tmp_path / "none.txt")
    refused("cannot be read", read_trajectory, tmp_path)
    (tmp_path / "a.db").write_bytes(b"SQLite format 3\0")
    refused("SQLite", read_trajectory, tmp_path / "a.db")
    (tmp_path / "a.bin").write_bytes(b"1 2 \xff\xfe")
    refused("not a text file", read_trajectory, tmp_path / "a.bin")


KITTI = ["1 0 0 5 0 1 0 6 0 0 1 7", "0 0 1 1 0 1 0 2 -1 0 0 3"]


def test_kitti_with_times(tmp_path: Path) -> None:
    path, times = saved(tmp_path, "\n".join(KITTI)), saved(tmp_path, "0.1\n0.2\n", "times.txt")
    trajectory = read_trajectory(path, times)
    np.testing.assert_array_equal(trajectory.timestamps, [0.1, 0.2])
    np.testing.assert_array_equal(trajectory.world_T_rigs[0, :3, 3], [5, 6, 7])
    turned = [[0, 0, 1, 1], [0, 1, 0, 2], [-1, 0, 0, 3], [0, 0, 0, 1]]
    np.testing.assert_allclose(trajectory.world_T_rigs[1], turned, atol=1e-15)


def test_refused_kitti(tmp_path: Path) -> None:
    path = saved(tmp_path, "\n".join(KITTI))
    refused("pass --timestamps FILE with one for each of the 2 rows", read_trajectory, path)
    refused("2 poses but 3 times", read_trajectory, path, saved(tmp_path, "1\n2\n3\n", "times.txt"))
    with pytest.raises(GsbaError, match=r"traj\.txt:2: timestamp 1\.0 occurs twice"):
        read_trajectory(path, saved(tmp_path, "1\n1\n", "times.txt"))
    for row in ("-1 0 0 5 0 1 0 6 0 0 1 7", "2 0 0 5 0 1 0 6 0 0 1 7"):
        path = saved(tmp_path, f"{KITTI[0]}\n{row}\n")
        with pytest.raises(GsbaError, match=r"traj\.txt:2: the left 3x3 block is not a rotation"):
            read_trajectory(path, saved(tmp_path, "1\n2\n", "times.txt"))


def stella_map(world_T_rigs: np.ndarray, times: list[float]) -> dict:
    keyframes = {}
    for i in reversed(range(len(times))):  # a map is not in time order
        rig_T_world = np.linalg.inv(world_T_rigs[i])
        keyframes[str(i)] = {
            "descs": [[1, 2, 3]] * 4,
            "ts": times[i],
            "rot_cw": Rotation.from_matrix(rig_T_world[:3, :3]).as_quat().tolist(),
            "trans_cw": rig_T_world[:3, 3].tolist(),
        }
    landmarks = {"0": {"pos_w": [0.0, 0.0, 0.0]}}
    return {"cameras": {}, "keyframes": keyframes, "landmarks": landmarks}


def test_stella_map(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    expected = pose(Rotation.random(4, rng=rng).as_matrix(), rng.normal(size=(4, 3)))
    path = tmp_path / "map.msg"
    path.write_bytes(packed(stella_map(expected, [0.0, 0.5, 2.0, 10.0])))
    trajectory = read_trajectory(path)
    np.testing.assert_array_equal(trajectory.timestamps, [0, 0.5, 2, 10])
    np.testing.assert_allclose(trajectory.world_T_rigs, expected, atol=1e-14)


def packed(value: object) -> bytes:
    data = msgpack.packb(value)
    assert isinstance(data, bytes)
    return data


def test_refused_stella_maps(tmp_path: Path) -> None:
    path = tmp_path / "map.msg"
    whole = stella_map(np.stack([np.eye(4)] * 3), [0.0, 1.0, 2.0])
    data = packed(whole)
    lacking = stella_map(np.stack([np.eye(4)] * 3), [0.0, 1.0, 2.0])
    del lacking["keyframes"]["1"]["rot_cw"]
    for bad in (
        data[: len(data) // 2],
        packed({"a": 1}),
        packed(lacking),
        packed({"keyframes": 3}),
    ):
        path.write_bytes(bad)
        refused(r"map\.msg: damaged, or not a stella_vslam map", read_trajectory, path)
    for key, value, message in [
        ("rot_cw", [0.0] * 4, "keyframe 1: quaternion is zero"),
        ("trans_cw", [0.0, float("nan"), 0.0], "keyframe 1: holds a number that is not finite"),
        ("ts", 0.0, "timestamp 0.0 occurs twice: write each once, with all digits"),
    ]:
        bad = stella_map(np.stack([np.eye(4)] * 3), [0.0, 1.0, 2.0])
        bad["keyframes"]["1"][key] = value
        path.write_bytes(packed(bad))
        refused(message, read_trajectory, path)


finite = st.floats(-1e6, 1e6, allow_nan=False)
components = st.lists(st.floats(-1, 1, allow_nan=False), min_size=4, max_size=4)
rows = st.tuples(st.lists(finite, min_size=3, max_size=3), components)


@settings(max_examples=60, deadline=None)
@given(
    times=st.lists(st.floats(-1e10, 1e10, allow_nan=False), min_size=2, max_size=12, unique=True),
    data=st.data(),
)
def test_written_trajectories_read_back(times: list[float], data: st.DataObject) -> None:
    times = sorted({t + 0.0 for t in times})
    drawn = data.draw(st.lists(rows, min_size=len(times), max_size=len(times)))
    quaternions = np.array([q if np.linalg.norm(q) > 1e-3 else [0, 0, 0, 1] for _, q in drawn])
    rotations = Rotation.from_quat(quaternions).as_matrix()
    trajectory = Trajectory(np.array(times), pose(rotations, np.array([p for p, _ in drawn])))
    with tempfile.TemporaryDirectory() as folder:
        write_tum(Path(folder) / "a.tum", trajectory)
        again = read_trajectory(Path(folder) / "a.tum")
        assert [p.name for p in Path(folder).iterdir()] == ["a.tum"]
    np.testing.assert_array_equal(again.timestamps, trajectory.timestamps)
    # 15 significant digits of at most 1e6 are 1e-9; quaternions of 15 digits leave 1e-14 in R.
    np.testing.assert_allclose(
        again.world_T_rigs[:, :3, 3], trajectory.world_T_rigs[:, :3, 3], rtol=0, atol=1e-9
    )
    np.testing.assert_allclose(again.world_T_rigs[:, :3, :3], rotations, rtol=0, atol=1e-13)


@settings(max_examples=200, deadline=None)
@given(text=st.text(alphabet="0123456789.-+eE \t\n#,naifx", max_size=200))
def test_any_text_is_read_or_refused_in_one_line(text: str) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = saved(Path(folder), text)
        try:
            trajectory = read_trajectory(path)
        except GsbaError as error:
            assert str(path) in str(error) and "\n" not in str(error)
        else:
            assert np.isfinite(trajectory.world_T_rigs).all()
            assert (np.diff(trajectory.timestamps) > 0).all()


def test_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    path = saved(tmp_path, "old", "a.tum")
    bad = Trajectory(np.array([0.0, 1.0]), np.stack([np.eye(4)]))  # lengths differ
    with pytest.raises(ValueError, match="zip"):
        write_tum(path, bad)
    assert path.read_text() == "old" and len(list(tmp_path.iterdir())) == 1
    good = Trajectory(np.array([0.0, 1.0]), np.stack([np.eye(4)] * 2))
    refused("cannot write", write_tum, tmp_path / "no" / "a.tum", good)


def test_poses_that_are_none_are_not_written(tmp_path: Path) -> None:
    path, poses = saved(tmp_path, "old", "a.tum"), np.stack([np.eye(4)] * 2)
    times, mirrored = np.array([0.0, 1.0]), poses.copy()
    mirrored[1, 0, 0] = -1
    refused("pose 1 cannot be written: its rotation", write_tum, path, Trajectory(times, mirrored))
    poses[1, 0, 3] = np.nan
    refused("pose 1 cannot be written: it is not", write_tum, path, Trajectory(times, poses))
    assert path.read_text() == "old"


@needs_shared
def test_real_map_agrees_with_its_keyframe_file() -> None:
    from_map = read_trajectory(SHARED / "apartment" / "map.msg")
    from_text = read_trajectory(SHARED / "apartment" / "keyframe_trajectory.txt")
    np.testing.assert_array_equal(from_map.timestamps, from_text.timestamps)
    # The text file has 9 digits.
    np.testing.assert_allclose(from_map.world_T_rigs, from_text.world_T_rigs, atol=3e-9)


@needs_shared
def test_real_files_survive_writing(tmp_path: Path) -> None:
    files = sorted(SHARED.glob("*/*.tum")) + sorted(SHARED.glob("*/**/*trajectory*.txt"))
    assert len(files) > 10
    for path in files:
        trajectory = read_trajectory(path)
        write_tum(tmp_path / "a.tum", trajectory)
        again = read_trajectory(tmp_path / "a.tum")
        np.testing.assert_array_equal(again.timestamps, trajectory.timestamps)
        np.testing.assert_allclose(again.world_T_rigs, trajectory.world_T_rigs, atol=1e-12)
