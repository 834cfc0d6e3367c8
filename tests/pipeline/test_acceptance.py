"""A run whose images determine no positions is refused, and one on a vehicle is named so."""

import importlib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import cv2
import numpy as np
import pytest
from plain_records import frames_of, map_of

from gsba.log import GsbaError
from gsba.pipeline import backend
from gsba.pipeline.acceptance import (
    MIN_STEP_SIGMAS,
    NoPositions,
    refuse_vehicle_in_pieces,
    require_motion,
    share_ahead,
    step_sigmas,
)
from gsba.pipeline.state import State
from gsba.types import FrameSet, JointErrors, PictureFormat, Reconstruction

NUM, SIGMA = 8, 0.02


def _result(step: float, num_points: int = 5) -> Reconstruction:
    """Frames along a line whose positions are known to SIGMA each, independently."""
    poses = np.tile(np.eye(4), (NUM, 1, 1))
    poses[:, 0, 3] = step * np.arange(NUM)
    covariances = np.tile(np.diag([1e-12] * 3 + [SIGMA**2] * 3), (NUM, 1, 1))
    joint = JointErrors(np.zeros((NUM - 1, 6, 6)), np.zeros((0, NUM, 6), np.float32))
    none, points = np.zeros(0), np.ones((num_points, 3))
    known = {"pose_covariances": covariances, "joint_errors": joint}
    return map_of(poses, points, none, none, none.reshape(0, 3), **known)


def _frames(folder: Path, masked_rows: int) -> FrameSet:
    """Panoramas of 32 rows, of which the lowest are masked."""
    mask = np.full((32, 64), 255, np.uint8)
    mask[32 - masked_rows :] = 0
    cv2.imwrite(str(folder / "mask.png"), mask)
    paths = ((folder / "0.jpg",),) * NUM
    return frames_of(PictureFormat("erp", 64, 32), paths, mask=folder / "mask.png")


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


def test_where_the_camera_stands_says_nothing_of_where_it_walks() -> None:
    """Every frame twice; a camera that turns on the spot does not stand."""
    walked, stood = _result(1.0), _result(0.0)
    twice = replace(walked, world_T_rigs=walked.world_T_rigs[np.arange(NUM) // 2])
    assert len(step_sigmas(twice)) == (NUM - 1) // 2 and step_sigmas(twice).min() > MIN_STEP_SIGMAS
    assert step_sigmas(stood).max() < MIN_STEP_SIGMAS
    turning = replace(twice, world_T_rigs=twice.world_T_rigs.copy())
    angles = np.deg2rad(np.arange(NUM) % 2)
    turning.world_T_rigs[:, 0, 0] = turning.world_T_rigs[:, 2, 2] = np.cos(angles)
    turning.world_T_rigs[:, 0, 2], turning.world_T_rigs[:, 2, 0] = np.sin(angles), -np.sin(angles)
    assert len(step_sigmas(turning)) == NUM - 1


def test_a_walk_of_few_steps_is_one_though_the_camera_mostly_turns_on_the_spot(
    tmp_path: Path,
) -> None:
    result, angles = _result(2.0), np.deg2rad(5 * np.arange(NUM))
    poses = result.world_T_rigs.copy()
    poses[:, 0, 3] = np.maximum(poses[:, 0, 3] - poses[-3, 0, 3], 0)  # the last two steps walk
    poses[:, 0, 0] = poses[:, 2, 2] = np.cos(angles)
    poses[:, 0, 2], poses[:, 2, 0] = np.sin(angles), -np.sin(angles)
    mostly = replace(result, world_T_rigs=poses)
    assert np.median(step_sigmas(mostly)) < MIN_STEP_SIGMAS
    require_motion(_frames(tmp_path, 4), mostly)
    with pytest.raises(GsbaError, match="50 % of the picture turn with the camera, as a vehicle"):
        require_motion(_frames(tmp_path, 16), mostly)
    poses[-2:, 0, 3] = 0
    with pytest.raises(NoPositions, match="hardly moves"):
        require_motion(_frames(tmp_path, 4), mostly)


def _driven(turn_deg: float, backwards: int) -> Reconstruction:
    """Steps ahead of a camera that turns at each, the last few back again."""
    result, poses = _result(1.0), [np.eye(4)]
    cosine, sine = np.cos(np.deg2rad(turn_deg)), np.sin(np.deg2rad(turn_deg))
    for n in range(NUM - 1):
        step = np.array([[cosine, 0, sine, 0], [0, 1, 0, 0], [-sine, 0, cosine, 0], [0, 0, 0, 1]])
        step[2, 3] = -1.0 if n >= NUM - 1 - backwards else 1.0
        poses.append(poses[-1] @ step)
    return replace(result, world_T_rigs=np.array(poses))


def test_a_vehicle_does_not_go_to_and_fro(tmp_path: Path) -> None:
    assert share_ahead(_driven(40.0, 0)) == pytest.approx(1)
    assert share_ahead(_driven(0.0, 3)) == pytest.approx(1 / 7)
    hand = _frames(tmp_path, 4)
    require_motion(hand, _driven(0.0, 3))
    vehicle = _frames(tmp_path, 16)
    for turn_deg in (0.0, 40.0):
        require_motion(vehicle, _driven(turn_deg, 0))
    with pytest.raises(GsbaError, match=r"50 % of the picture.*14 % of the way.*go the same way"):
        require_motion(vehicle, _driven(0.0, 3))
    poses = _driven(0.0, 3).world_T_rigs
    poses[3:, 2, 3] += 1000  # one long step does not outweigh the others
    assert share_ahead(replace(_result(1.0), world_T_rigs=poses)) == pytest.approx(1 / 7)


def test_turns_alone_are_a_result_but_not_on_a_vehicle(tmp_path: Path) -> None:
    require_motion(_frames(tmp_path, 8), _result(0.0, num_points=0))
    with pytest.raises(GsbaError, match=r"nothing but turns.*as a vehicle does"):
        require_motion(_frames(tmp_path, 16), _result(0.0, num_points=0))


def test_a_way_in_pieces_is_refused_on_a_vehicle(tmp_path: Path) -> None:
    refuse_vehicle_in_pieces(_frames(tmp_path, 8))
    with pytest.raises(GsbaError, match=r"the camera was lost on the way.*a part that holds"):
        refuse_vehicle_in_pieces(_frames(tmp_path, 16))


@pytest.mark.parametrize(
    ("guided", "followed", "proved", "rotations"),
    [
        (False, False, True, True),
        (True, True, True, True),  # the odometry of the same images
        (True, False, True, False),  # a trajectory of the user's
        (False, False, False, False),
    ],
)
def test_rotations_alone_are_refined_where_a_turn_is_proved(
    monkeypatch: pytest.MonkeyPatch, guided: bool, followed: bool, proved: bool, rotations: bool
) -> None:
    turn, result = SimpleNamespace(prior=None), object()

    def no_map(_: object) -> None:
        raise NoPositions("the images determine no positions")

    module = importlib.import_module("gsba.pipeline.refine")
    monkeypatch.setattr(module, "_solve_raw", no_map)
    monkeypatch.setattr(module.frontend, "extract", lambda run: run)
    monkeypatch.setattr(module.frontend, "prove_turn", lambda _: turn if proved else None)
    monkeypatch.setattr(module.backend, "reconstruct", lambda _: result)
    monkeypatch.setattr(module.acceptance, "require_motion", lambda *_: None)
    evidence, coarse = SimpleNamespace(recordings=()), SimpleNamespace(absent=not guided)
    run = SimpleNamespace(evidence=evidence, coarse=coarse, frames=None)
    if rotations:
        assert module._solve_or_turn(run, followed) == (turn, result)
        return
    with pytest.raises(NoPositions, match="determine no positions"):
        module._solve_or_turn(run, followed)


@pytest.mark.parametrize(
    ("doubtful", "cause"),
    [
        (True, "7 of 7 steps lead to and fro.*name stills in the order"),
        (False, "few points are seen from both sides"),
    ],
)
def test_steps_that_are_all_doubted_are_no_turn_on_the_spot(
    monkeypatch: pytest.MonkeyPatch, doubtful: bool, cause: str
) -> None:
    apart, steps = np.arange(NUM), np.full(NUM - 1, doubtful)
    monkeypatch.setattr(backend, "_doubtful_steps", lambda _: steps)
    run = SimpleNamespace(stage=lambda *_: SimpleNamespace(components=apart), matching_key=list)
    prior = SimpleNamespace(absent=True, trust=None, joints=())
    state = SimpleNamespace(run=run, prior=prior, solution=None)
    with pytest.raises(NoPositions, match=cause):
        backend.merge_maps(cast(State, state), apart)
