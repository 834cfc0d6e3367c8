"""Trajectory files as `world_T_rigs`: TUM, KITTI, stella_vslam's map; writing TUM."""

import logging
import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gsba.disk import write_bytes
from gsba.frames.times import read_lines, read_times, seconds
from gsba.geometry import (
    as_rotations,
    inverse,
    pose,
    quaternion_from_rotation,
    rotation_from_quaternion,
)
from gsba.log import GsbaError, brief
from gsba.types import Trajectory

if TYPE_CHECKING:
    import msgpack

_log = logging.getLogger(__name__)

MAX_COORDINATE = 1e12  # largest coordinate, in any unit: beyond, differences lose precision
_KITTI_COLUMNS = 12  # of a row: 3 x 4, row-major
_UNIT_TOLERANCE = 1e-3  # largest deviation of a quaternion's norm from one


def read_trajectory(path: Path, timestamps: Path | None = None) -> Trajectory:
    """Timed rig poses of a TUM, KITTI or stella_vslam map (`.msg`) file, recognised by its content.

    TUM: `timestamp tx ty tz qx qy qz qw`, world_T_rig. KITTI: 12 numbers, row-major 3x4
    world_T_rig, times from `timestamps`, one for each row. A map gives its keyframes.

    After a loop closure of stella_vslam, give its keyframes: the frame poses still hang on relative
    poses from before the closure, and interpolating the keyframes was three times more accurate.

    Rows by which a SLAM says that it lost a frame are rows without a pose, and left out: NaN or
    infinite values, a quaternion of zeros, positions beyond 1e12. Raises GsbaError: a line cannot
    be used; the message names file and line.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            head = file.read(16)
    except OSError as error:
        raise GsbaError(f"{path}: cannot be read ({error.strerror})") from None
    if head.startswith(b"SQLite format 3"):
        raise GsbaError(f"{path}: a SQLite map; save it as map.msg or give frame_trajectory.txt")
    if head and (0x80 <= head[0] <= 0x8F or head[0] in (0xDE, 0xDF)):  # a MessagePack map
        return _read_stella_map(path)
    rows = read_lines(path)
    if not rows:
        raise GsbaError(f"{path}: holds no poses")
    columns = len(rows[0][1].split())
    if columns == 8:
        return _read_tum(path, rows)
    if columns == _KITTI_COLUMNS:
        return _read_kitti(path, rows, timestamps)
    found = f"{columns} values"
    if columns == 1 and "," in rows[0][1]:
        found = "values separated by commas"
    elif rows[0][1].startswith(("{", "[")):
        found = "JSON, as nerfstudio's transforms.json"
    elif columns == 10:
        found = "10 values, as in COLMAP's images.txt, whose poses are inverted"
    raise GsbaError(
        f"{path}:{rows[0][0]}: {found}; want 8 separated by blanks (TUM: timestamp tx ty "
        "tz qx qy qz qw) or 12 (KITTI)"
    )


def is_kitti(path: Path) -> bool:
    """True if a file holds rows of KITTI, whose poses have no times."""
    with suppress(GsbaError):  # a map, or no file
        rows = read_lines(path)
        return bool(rows) and len(rows[0][1].split()) == _KITTI_COLUMNS
    return False


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write `timestamp tx ty tz qx qy qz qw` lines that `read_trajectory` takes back.

    Timestamps survive exactly, values to 15 digits. The file appears whole or not at all.
    GsbaError: it cannot be written, or a pose is not finite or holds no rotation.
    """
    path, poses = Path(path), trajectory.world_T_rigs
    finite = np.isfinite(poses).all(axis=(1, 2)) & np.isfinite(trajectory.timestamps)
    right = finite & as_rotations(np.where(finite[:, None, None], poses, 0)[:, :3, :3])[1]
    if not right.all():
        what = "its rotation is none" if finite[right.argmin()] else "it is not finite"
        raise GsbaError(f"{path}: pose {right.argmin()} cannot be written: {what}")
    wxyz = quaternion_from_rotation(trajectory.world_T_rigs[:, :3, :3])
    values = np.hstack([trajectory.world_T_rigs[:, :3, 3], wxyz[:, [1, 2, 3, 0]]])
    lines = [
        " ".join([repr(float(time)), *(f"{value:.15g}" for value in row)]) + "\n"
        for time, row in zip(trajectory.timestamps, values, strict=True)
    ]
    write_bytes(path, "".join(lines).encode("ascii"), parents=False)


def _read_tum(path: Path, rows: Sequence[tuple[int, str]]) -> Trajectory:
    where, cells = _split(path, rows, 8)
    times = np.array([_number(c[0], w, seconds) for c, w in zip(cells, where, strict=True)])
    values = np.array([[_value(v, w) for v in c[1:]] for c, w in zip(cells, where, strict=True)])
    tracked = _tracked(path, values, values[:, :3], (values[:, 3:] != 0).any(axis=1), where)
    where, times, values = [where[i] for i in tracked], times[tracked], values[tracked]
    rotations = _rotations(values[:, [6, 3, 4, 5]], where)
    return _trajectory(path, times, pose(rotations, values[:, :3]), where)


def _tracked(
    path: Path, values: np.ndarray, positions: np.ndarray, turned: np.ndarray, where: Sequence[str]
) -> np.ndarray:
    """Rows (M,) of N that have a pose, at least 2 unless N is less; others are logged."""
    known = np.isfinite(values).all(axis=1) & turned
    known &= (np.abs(np.where(known[:, None], positions, 0)) <= MAX_COORDINATE).all(axis=1)
    lost = np.flatnonzero(~known)
    if len(lost) and known.sum() < 2:
        raise GsbaError(
            f"{where[lost[0]]}: no pose (NaN, zeros, or a position beyond {MAX_COORDINATE:g}), as "
            f"in {len(lost)} of {len(known)} rows; at least 2 poses are needed"
        )
    if len(lost):
        _log.warning(
            "%s: %d of %d rows without a pose, as of lost frames (NaN, zeros, or positions beyond "
            "%g; the first is %s): left out",
            path,
            len(lost),
            len(known),
            MAX_COORDINATE,
            where[lost[0]],
        )
    return np.flatnonzero(known)


def _read_kitti(path: Path, rows: Sequence[tuple[int, str]], timestamps: Path | None) -> Trajectory:
    if timestamps is None:
        raise GsbaError(
            f"{path}: KITTI poses carry no times; pass --timestamps FILE with one for each of the "
            f"{len(rows)} rows, or give the TUM file"
        )
    times = np.array([row.timestamp for row in read_times(timestamps)])
    if len(times) != len(rows):
        raise GsbaError(
            f"{path}: {len(rows)} poses but {len(times)} times in {timestamps}; frames lost by the "
            "SLAM have no row in a KITTI file, so give the TUM file or a matching list"
        )
    where, cells = _split(path, rows, _KITTI_COLUMNS)
    values = np.array([[_value(v, w) for v in c] for c, w in zip(cells, where, strict=True)])
    world_P_rigs = values.reshape(-1, 3, 4)
    turned = (world_P_rigs[:, :, :3] != 0).any(axis=(1, 2))
    tracked = _tracked(path, values, world_P_rigs[:, :, 3], turned, where)
    where, times = [where[i] for i in tracked], times[tracked]
    world_P_rigs = world_P_rigs[tracked]
    nearest, is_one = as_rotations(world_P_rigs[:, :, :3])
    if not is_one.all():
        raise GsbaError(f"{where[is_one.argmin()]}: the left 3x3 block is not a rotation")
    return _trajectory(path, times, pose(nearest, world_P_rigs[:, :, 3]), where)


def _read_stella_map(path: Path) -> Trajectory:
    """Keyframes of a stella_vslam map: `ts`, and `rot_cw` (xyzw), `trans_cw` from the world."""
    import msgpack

    try:
        with path.open("rb") as file:
            keyframes = _keyframes(msgpack.Unpacker(file, raw=False))
        where = [f"{path}: keyframe {name}" for name in keyframes]
        rows = [
            np.array([k["ts"], *k["trans_cw"], *k["rot_cw"]], np.float64)
            for k in keyframes.values()
        ]
        values = np.array(rows, dtype=np.float64).reshape(len(rows), 8)
    except OSError as error:
        raise GsbaError(f"{path}: cannot be read ({error.strerror})") from None
    except (msgpack.UnpackException, ValueError, TypeError, KeyError):
        raise GsbaError(f"{path}: damaged, or not a stella_vslam map") from None
    bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
    if len(bad):
        raise GsbaError(f"{where[bad[0]]}: holds a number that is not finite")
    order = np.argsort(values[:, 0], kind="stable")  # a map has no order of its own
    where, values = [where[i] for i in order], values[order]
    rig_T_worlds = pose(_rotations(values[:, [7, 4, 5, 6]], where), values[:, 1:4])
    return _trajectory(path, values[:, 0], inverse(rig_T_worlds), where)


def _keyframes(unpacker: "msgpack.Unpacker") -> dict[str, dict[str, Any]]:
    """Pose fields of each keyframe, streaming past the descriptors and landmarks."""
    for _ in range(unpacker.read_map_header()):
        if unpacker.unpack() != "keyframes":
            unpacker.skip()
            continue
        keyframes: dict[str, dict[str, Any]] = {}
        for _ in range(unpacker.read_map_header()):
            fields = keyframes[unpacker.unpack()] = {}
            for _ in range(unpacker.read_map_header()):
                name = unpacker.unpack()
                if name in ("ts", "rot_cw", "trans_cw"):
                    fields[name] = unpacker.unpack()
                else:
                    unpacker.skip()
        return keyframes
    raise KeyError("keyframes")


def _split(
    path: Path, rows: Sequence[tuple[int, str]], columns: int
) -> tuple[list[str], list[list[str]]]:
    """Place ("file:line") and cells of each row, all with the same number of columns."""
    where, cells = [], []
    for line, text in rows:
        where.append(f"{path}:{line}")
        cells.append(text.split())
        if len(cells[-1]) != columns:
            raise GsbaError(f"{where[-1]}: {len(cells[-1])} values where others have {columns}")
    return where, cells


def _number(text: str, where: str, parse: Callable[[str], float] = float) -> float:
    try:
        value = parse(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise GsbaError(f"{where}: '{brief(text)}' is not a finite number")
    return value


def _value(text: str, where: str) -> float:
    """A number of a pose, which may be NaN or infinite."""
    try:
        return float(text)
    except ValueError:
        raise GsbaError(f"{where}: '{brief(text)}' is not a number") from None


def _rotations(wxyz: np.ndarray, where: Sequence[str]) -> np.ndarray:
    """Rotations (N, 3, 3) of quaternions (N, 4) that are unit to within the tolerance."""
    with np.errstate(over="ignore"):  # infinite ones are refused
        norms = np.linalg.norm(wxyz, axis=1)
    bad = np.flatnonzero(np.abs(norms - 1) > _UNIT_TOLERANCE)
    if len(bad):
        norm = norms[bad[0]]
        what = "is zero" if norm == 0 else f"has norm {norm:.6g}, not 1"
        raise GsbaError(f"{where[bad[0]]}: quaternion {what}")
    return rotation_from_quaternion(wxyz / norms[:, None])


def _trajectory(
    path: Path, times: np.ndarray, world_T_rigs: np.ndarray, where: Sequence[str]
) -> Trajectory:
    if len(times) < 2:
        raise GsbaError(f"{path}: {len(times)} poses; at least 2 are needed")
    far = np.flatnonzero(np.abs(world_T_rigs[:, :3, 3]).max(axis=1) > MAX_COORDINATE)
    if len(far):
        raise GsbaError(
            f"{where[far[0]]}: a position further than {MAX_COORDINATE:g} from the origin"
        )
    late = np.flatnonzero(np.diff(times) <= 0)
    if len(late):
        before, after = float(times[late[0]]), float(times[late[0] + 1])
        what = f"comes after {before!r}; sort the file"
        if before == after:
            what = "occurs twice: write each once, with all digits"
        raise GsbaError(f"{where[late[0] + 1]}: timestamp {after!r} {what}")
    return Trajectory(times, world_T_rigs)
