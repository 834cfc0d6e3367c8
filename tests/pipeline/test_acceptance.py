"""A run whose images determine no positions is refused, and one on a vehicle is named so."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from gsba.log import GsbaError
from gsba.pipeline.acceptance import (
    MIN_STEP_SIGMAS,
    refuse_vehicle_in_pieces,
    require_motion,
    step_sigmas,
)
from gsba.types import FrameSet, JointErrors, PictureFormat, Reconstruction

NUM, SIGMA = 8, 0.02


def _result(step: float, num_points: int = 5) -> Reconstruction:
    """Frames along a line whose positions are known to SIGMA each, independently."""
    poses = np.tile(np.eye(4), (NUM, 1, 1))
    poses[:, 0, 3] = step * np.arange(NUM)
    covariances = np.tile(np.diag([1e-12] * 3 + [SIGMA**2] * 3), (NUM, 1, 1))
    joint = JointErrors(np.zeros((NUM - 1, 6, 6)), np.zeros((0, NUM, 6), np.float32))
    none = np.zeros(0)
    return Reconstruction(
        poses,
        covariances,
        np.zeros(NUM, np.uint8),
        np.ones((num_points, 3)),
        np.zeros((num_points, 3), np.uint8),
        np.zeros(num_points),
        none.astype(np.int32),
        none.astype(np.int32),
        none.reshape(0, 3),
        none,
        joint_errors=joint,
    )


def _frames(folder: Path, masked_rows: int) -> FrameSet:
    """Panoramas of 32 rows, of which the lowest are masked."""
    mask = np.full((32, 64), 255, np.uint8)
    mask[32 - masked_rows :] = 0
    cv2.imwrite(str(folder / "mask.png"), mask)
    return FrameSet(
        tuple(f"{n}" for n in range(NUM)),
        ((folder / "0.jpg",),) * NUM,
        np.arange(NUM, dtype=np.float64),
        (folder / "mask.png",) * NUM,
        (PictureFormat("erp", 64, 32),),
    )


def test_steps_are_measured_by_their_own_noise() -> None:
    """Of two independent positions of three coordinates each."""
    np.testing.assert_allclose(step_sigmas(_result(1.0)), 1 / (np.sqrt(6) * SIGMA), rtol=1e-6)


def test_positions_that_images_do_not_determine_are_refused(tmp_path: Path) -> None:
    noise = np.sqrt(6) * SIGMA
    hand = _frames(tmp_path, 4)
    require_motion(hand, _result(1.1 * MIN_STEP_SIGMAS * noise))
    with pytest.raises(GsbaError, match=r"the images determine no positions.*hardly moves"):
        require_motion(hand, _result(0.9 * MIN_STEP_SIGMAS * noise))
    vehicle = _frames(tmp_path, 16)
    with pytest.raises(GsbaError, match="50 % of the picture turn with the camera, as a vehicle"):
        require_motion(vehicle, _result(0.0))


def test_turns_alone_are_a_result_but_not_on_a_vehicle(tmp_path: Path) -> None:
    require_motion(_frames(tmp_path, 8), _result(0.0, num_points=0))
    with pytest.raises(GsbaError, match=r"nothing but turns.*as a vehicle does"):
        require_motion(_frames(tmp_path, 16), _result(0.0, num_points=0))


def test_a_way_in_pieces_is_refused_on_a_vehicle(tmp_path: Path) -> None:
    refuse_vehicle_in_pieces(_frames(tmp_path, 8))
    with pytest.raises(GsbaError, match=r"the camera was lost on the way.*a part that holds"):
        refuse_vehicle_in_pieces(_frames(tmp_path, 16))
