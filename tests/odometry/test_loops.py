"""Loops and joins of a tracked walk: found where they are, measured, and not made up."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest
from dense_walk import WIDTH, RenderedWalk
from scipy.spatial.transform import Rotation

from gsba.evaluate.trajectory import evaluate
from gsba.geometry import pose
from gsba.loop_closure.map_similarity import Meeting
from gsba.odometry import Odometry, track_panoramas
from gsba.odometry.closing import fit_loop, moved
from gsba.odometry.panoramas import SmallPanoramas
from gsba.similarity import Sim3, similarity_along
from gsba.types import Trajectory

FPS = 4.0


def _followed(frames: Sequence[np.ndarray]) -> Odometry:
    def read(rows: Sequence[int], _colour: bool) -> Iterator[tuple[int, np.ndarray]]:
        return ((row, frames[row]) for row in rows)

    times = np.arange(len(frames)) / FPS
    return track_panoramas(SmallPanoramas(Path("walk"), times, WIDTH, read, ""))


def _ate(found: Odometry, truth: np.ndarray) -> float:
    """Of the frames of the first map, a part of their path."""
    rows = np.flatnonzero(found.maps_in_turn() == 1)
    times, true = found.timestamps[rows], truth[rows]
    errors = evaluate(Trajectory(times, found.world_T_rigs[rows]), Trajectory(times, true))
    return errors.ate.rmse / np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=1).sum()


def _dark(frames: list[np.ndarray], rows: range) -> list[np.ndarray]:
    rng = np.random.default_rng(3)
    out = list(frames)
    for n in rows:
        out[n] = np.clip(rng.normal(4, 2, out[n].shape), 0, 255).astype(np.uint8)
    return out


def test_points_tell_the_ratio_of_units_once_bearings_tell_the_pose() -> None:
    rng = np.random.default_rng(0)
    points1 = rng.normal(size=(60, 3)) * 2
    truth = Sim3(
        1.4, Rotation.from_rotvec([0.2, -0.5, 0.1]).as_matrix(), np.array([0.3, 0.1, -0.4])
    )
    points0 = truth.points(points1)
    points1 *= np.exp(rng.normal(0, 0.05, (60, 1)))  # distances are known to 5 %
    points0[:15] = rng.normal(size=(15, 3))  # false
    step = pose(truth.rotation, truth.translation / np.linalg.norm(truth.translation))
    found = similarity_along(points0, points1, step)
    assert found is not None
    fit, agree = found
    assert fit.scale == pytest.approx(1.4, rel=0.03) and agree[15:].sum() > 35
    np.testing.assert_allclose(fit.translation, truth.translation, atol=0.05)
    assert similarity_along(points0[:15], points1[:15], step) is None


def test_a_loop_is_as_far_off_as_its_covariance_says() -> None:
    rng = np.random.default_rng(1)
    truth = Sim3(1.1, Rotation.from_rotvec([0.1, 0.6, 0.0]).as_matrix(), np.array([0.2, 0.0, 0.3]))
    poses = np.stack([np.eye(4), np.eye(4)])  # places 0 (f) and 1 (g)
    off = []
    for _ in range(20):
        own = rng.normal(size=(80, 3)) * 2
        theirs = truth.points(own)
        noisy = [
            points * np.exp(rng.normal(0, 0.07, (80, 1))) + 0.006 * rng.normal(size=(80, 3))
            for points in (own, theirs)
        ]
        start = moved(truth, 0.02 * rng.normal(size=7))
        fitted = fit_loop([Meeting(0, 1, *noisy)], poses, (0, 1), start)
        assert fitted is not None
        fit, covariance = fitted
        between = fit.rotation.T @ truth.rotation
        error = np.concatenate(
            [
                Rotation.from_matrix(between).as_rotvec(),
                fit.rotation.T @ (truth.translation - fit.translation) / fit.scale,
                [np.log(truth.scale / fit.scale)],
            ]
        )
        off.append(error @ np.linalg.solve(covariance, error) / 7)
    strange = Meeting(0, 1, rng.normal(size=(80, 3)), rng.normal(size=(80, 3)))
    assert fit_loop([strange], poses, (0, 1), truth) is None
    assert 0.02 < np.mean(off) < 1.0  # never too sure; that errors are independent is not believed


def test_a_walk_there_and_back_closes_its_loop(walk: RenderedWalk) -> None:
    there = walk.at([*range(24), *range(24, -1, -1)])
    found = _followed(there.frames)
    assert len(found.loops) >= 1 and len(np.unique(found.maps)) == 1
    positions = found.world_T_rigs[:, :3, 3]
    met = np.linalg.norm(positions[found.loops[:, 0]] - positions[found.loops[:, 1]], axis=1)
    assert met.max() < 1.0  # median distances of what is seen
    assert _ate(found, there.world_T_rigs) < 0.005
    assert "closed" in found.summary()
    sigmas = np.sqrt(np.trace(found.covariances[:, 3:, 3:], axis1=1, axis2=2))
    assert np.isfinite(sigmas).all() and sigmas.max() < 0.2  # median distances


@pytest.mark.slow
def test_a_map_begun_in_the_dark_is_joined_where_it_meets_the_first(walk: RenderedWalk) -> None:
    order = [*range(33), *range(33, -1, -1)]
    there = walk.at(order)
    frames = there.frames[:17] + [there.frames[17]] * 8 + there.frames[40:]
    truth = np.concatenate([there.world_T_rigs[:25], there.world_T_rigs[40:]])
    found = _followed(_dark(frames, range(17, 25)))
    assert len(found.lost()) == 1
    assert len(np.unique(found.maps[found.posed()])) == 1
    assert _ate(found, truth) < 0.01


@pytest.mark.slow
def test_maps_that_share_a_poster_stay_apart(walk: RenderedWalk) -> None:
    elsewhere = [np.ascontiguousarray(frame[:, ::-1]) for frame in walk.frames]
    for other, frame in zip(elsewhere, walk.frames, strict=True):
        other[90:170, 180:250] = frame[90:170, 180:250]
    frames = [*walk.frames[:16], *[walk.frames[16]] * 8, *elsewhere[:16]]
    found = _followed(_dark(frames, range(16, 24)))
    assert len(np.unique(found.maps[found.posed()])) == 2
    assert not len(found.joins) and not len(found.loops)
    first, second = found.pieces()
    np.testing.assert_array_equal(second.world_T_rigs[0], np.eye(4))
    assert first.timestamps[-1] < second.timestamps[0]
    assert "2 maps that nothing ties together" in found.summary()


def test_a_dark_beginning_leaves_the_covariances_as_they_are(walk: RenderedWalk) -> None:
    """They are relative to the first keyframe that shows something."""
    frames = walk.frames[:24]
    late = _followed([*_dark(frames[:2], range(2)), *frames])
    found, expected = late.covariances, _followed(frames).covariances
    assert found is not None and expected is not None
    assert not late.posed()[:2].any() and not late.keyframes[:2].any()
    assert np.isnan(found[:2]).all()
    ratios = np.einsum("fii->fi", found[2:]) / np.einsum("fii->fi", expected)
    assert ratios.min() > 0.5 and ratios.max() < 2.0
