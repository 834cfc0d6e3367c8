"""Induced pixel error: closed forms for a turned and for a shifted camera."""

import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from refusals import refused
from scipy.spatial.transform import Rotation

from gsba.evaluate.pixels import depth_maps, induced_errors
from gsba.geometry import pose
from gsba.log import GsbaError
from gsba.types import Trajectory

NUM, WIDTH, DEPTH = 12, 1024, 4.0
TRUTH = Trajectory(
    np.arange(NUM, dtype=float),
    pose(
        np.tile(np.eye(3), (NUM, 1, 1)),
        np.random.default_rng(0).normal(size=(NUM, 3)) * [1.0, 0.2, 1.0],
    ),
)


def _flat(_: int) -> np.ndarray:
    return np.full((64, 128), DEPTH, np.float32)


def test_the_truth_in_another_world_and_scale_induces_nothing() -> None:
    turn = Rotation.from_rotvec([0.3, -1.0, 0.5]).as_matrix()
    positions = 0.4 * TRUTH.world_T_rigs[:, :3, 3] @ turn.T + [3.0, -2.0, 1.0]
    moved = Trajectory(TRUTH.timestamps, pose(turn @ TRUTH.world_T_rigs[:, :3, :3], positions))
    errors = induced_errors(moved, TRUTH, _flat, WIDTH)
    assert errors.median_px < 1e-9 and errors.percentile95_px < 1e-9
    assert errors.steps == (1, 4) and errors.num_samples > 10_000


def test_a_turned_frame_moves_all_its_pixels() -> None:
    """About the vertical through a panorama's centre, far points move by angle x cos(latitude)."""
    angle, poses = 0.01, TRUTH.world_T_rigs.copy()
    poses[1::2, :3, :3] = Rotation.from_rotvec([0, angle, 0]).as_matrix()
    far = induced_errors(
        Trajectory(TRUTH.timestamps, poses), TRUTH, lambda _: 1e6 * _flat(0), WIDTH, steps=(1,)
    )
    latitudes = np.abs(np.linspace(-np.pi / 2, np.pi / 2, 1001))
    expected = np.median(angle * np.cos(latitudes)) * WIDTH / (2 * np.pi)
    assert far.median_px == pytest.approx(expected, rel=0.05)
    even = induced_errors(
        Trajectory(TRUTH.timestamps, poses), TRUTH, lambda _: 1e6 * _flat(0), WIDTH, steps=(2,)
    )
    assert even.median_px < 1e-6  # both frames turned alike


def test_missing_poses_and_depths_are_left_out() -> None:
    kept = np.array([0, 1, 2, 5, 6, 9])
    partial = Trajectory(TRUTH.timestamps[kept], TRUTH.world_T_rigs[kept])

    def half(_: int) -> np.ndarray:
        depth = _flat(0)
        depth[:, :64] = 0
        return depth

    whole = induced_errors(partial, TRUTH, _flat, WIDTH)
    assert whole.num_samples == 2 * induced_errors(partial, TRUTH, half, WIDTH).num_samples
    assert whole.median_px < 1e-9


def test_nothing_to_compare_is_one_clear_line(tmp_path: Path) -> None:
    two = Trajectory(TRUTH.timestamps[:2], TRUTH.world_T_rigs[:2])
    refused("only 2 poses", induced_errors, two, TRUTH, _flat, WIDTH)
    with pytest.raises(GsbaError, match="no frame with depth"):
        induced_errors(TRUTH, TRUTH, lambda _: np.zeros((64, 128)), WIDTH)
    for many in (np.full((64, 128), np.nan), np.full((64, 128), 1e300)):
        with pytest.raises(GsbaError, match="a distance above 0"):
            induced_errors(TRUTH, TRUTH, lambda _, many=many: many, WIDTH)
    refused("0 depth maps for 3 true poses", depth_maps, tmp_path, 3)


def test_depth_maps_are_read_in_name_order(tmp_path: Path) -> None:
    for k in (2, 0, 1):
        np.savez(tmp_path / f"{k:06d}.npz", range=np.full((2, 4), k))
    read = depth_maps(tmp_path, 3)
    assert [read(k)[0, 0] for k in range(3)] == [0, 1, 2]


def _savez_text(path: Path, header: str) -> None:
    """An archive whose array has a header like this."""
    text = header.encode().ljust(117) + b"\n"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("range.npy", b"\x93NUMPY\x01\x00" + bytes([len(text), 0]) + text)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda path: path.write_bytes(path.read_bytes()[:-40]), "(no|damaged) depth map"),
        (lambda path: path.write_bytes(path.read_bytes()[:60] + b"x" * 90), "depth map"),
        (lambda path: path.write_bytes(b""), "holds no array `range`"),
        (lambda path: path.write_text("range"), "holds no array `range`"),
        (lambda path: np.save(path.open("wb"), np.ones((2, 4))), "holds no array `range`"),
        (lambda path: np.savez(path, depth=np.ones((2, 4))), "holds no array `range`"),
        (lambda path: np.savez(path, range=np.array([{}, None])), "holds no array `range`"),
        (lambda path: _savez_text(path, "{'descr': '<f8', 'shape': (2, 4"), "damaged depth map"),
        (lambda path: np.savez(path, range=np.array([["a"]])), "must be an image of numbers"),
        (lambda path: np.savez(path, range=np.ones(8)), "must be an image of numbers"),
        (lambda path: np.savez(path, range=np.ones((0, 0))), "0x0, but it must be 2:1"),
        (lambda path: np.savez(path, range=np.ones((4, 4))), "4x4, but it must be 2:1"),
    ],
)
def test_damaged_depth_maps_are_named(
    tmp_path: Path, spoil: Callable[[Path], object], message: str
) -> None:
    np.savez(tmp_path / "0.npz", range=np.ones((2, 4)))
    spoil(tmp_path / "0.npz")
    refused(rf"0\.npz:? .*{message}|0\.npz:? {message}", depth_maps(tmp_path, 1), 0)
