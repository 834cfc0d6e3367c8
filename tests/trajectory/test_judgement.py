"""Steps of the trajectory before the court of the images."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic import RIG, bearings_of, drifted, keypoints_of, loop_walk, unit, with_noise

from gsba.config import PriorSettings
from gsba.geometry import inverse, pose, rotation_angle
from gsba.trajectory import judgement, turning
from gsba.trajectory.judgement import StepChecks
from gsba.trajectory.limits import TwoViewLimits
from gsba.trajectory.steps import chained, image_steps, length_ratios, off_steps, step_lengths
from gsba.types import CoarsePoses, Counts, Keypoints, Matches, PoseSource, VerifiedPairs

NUM_FRAMES, NUM_POINTS = 24, 80
VERIFY, PRIORS = TwoViewLimits(), PriorSettings()
TRUTH = loop_walk(NUM_FRAMES)


def _seen(
    missing: tuple[int, ...] = (), truth: np.ndarray = TRUTH
) -> tuple[VerifiedPairs, Keypoints]:
    """All neighbours but some verified; every frame sees every point."""
    rng = np.random.default_rng(1)
    points = rng.uniform(5, 8, (NUM_POINTS, 1)) * unit(rng.normal(size=(NUM_POINTS, 3)))
    bearings = np.concatenate(
        [with_noise(bearings_of(points, world_T_rig), 3e-4, rng) for world_T_rig in truth]
    )
    keypoints = keypoints_of(np.arange(NUM_FRAMES + 1) * NUM_POINTS, bearings, RIG.focal)
    steps = [f for f in range(NUM_FRAMES - 1) if f not in missing]
    f0_T_f1s = (inverse(truth[:-1]) @ truth[1:])[steps]
    lengths = np.linalg.norm(f0_T_f1s[:, :3, 3], axis=1)
    moved = lengths > 1e-9
    f0_T_f1s[:, :3, 3] /= np.where(moved, lengths, 1.0)[:, None]
    sigmas = np.where(moved, 0.0, np.inf)
    rows = np.tile(np.arange(NUM_POINTS, dtype=np.int32)[:, None], (len(steps), 2))
    matches = Matches(
        np.array([(f, f + 1) for f in steps], np.int32),
        np.arange(len(steps) + 1) * NUM_POINTS,
        rows,
    )
    counts = Counts(NUM_FRAMES - 1, len(steps), "pairs")
    return VerifiedPairs(matches, f0_T_f1s, sigmas, counts), keypoints


def _judge(
    slam: np.ndarray, missing: tuple[int, ...] = (), lost: tuple[int, ...] = ()
) -> StepChecks:
    pairs, keypoints = _seen(missing)
    sources = np.full(NUM_FRAMES, PoseSource.SLAM, np.uint8)
    sources[list(lost)] = PoseSource.INTERPOLATED
    found = image_steps(pairs, keypoints)
    logs, sigmas = length_ratios(pairs, found, keypoints)
    coarse = CoarsePoses(slam, sources, 0.0)
    return judgement.check_steps(coarse, found, logs, sigmas, VERIFY, PRIORS)


def _slam(seed: int = 0) -> np.ndarray:
    return drifted(TRUTH, np.random.default_rng(seed))


def test_ratios_of_lengths_come_from_common_points() -> None:
    pairs, keypoints = _seen()
    found = image_steps(pairs, keypoints)
    logs, sigmas = length_ratios(pairs, found, keypoints)
    true = np.linalg.norm(np.diff(TRUTH[:, :3, 3], axis=0), axis=1)
    assert found.verified.all() and found.directed.all() and np.isfinite(sigmas).all()
    np.testing.assert_allclose(logs, np.diff(np.log(true)), atol=0.03)


@pytest.mark.parametrize("seed", range(5))
def test_plain_drift_is_not_accused(seed: int) -> None:
    slam = _slam(seed)
    trust = _judge(slam)
    assert trust.sound and not trust.false_frames.any()
    np.testing.assert_array_equal(trust.world_T_rigs, slam)


def _fast_drift(rng: np.random.Generator) -> np.ndarray:
    """Every step off by a third of its length: more than half of them beyond what is believed."""
    steps = inverse(TRUTH[:-1]) @ TRUTH[1:]
    typical = np.median(np.linalg.norm(steps[:, :3, 3], axis=1))
    turns = np.deg2rad(1) * rng.normal(size=(len(steps), 3))
    steps[:, :3, :3] = steps[:, :3, :3] @ Rotation.from_rotvec(turns).as_matrix()
    steps[:, :3, 3] += 0.2 * typical * rng.normal(size=(len(steps), 3))
    return chained(steps)


@pytest.mark.parametrize("seed", range(10))
def test_fast_drift_loses_steps_but_accuses_no_frame(seed: int) -> None:
    trust = _judge(_fast_drift(np.random.default_rng(seed)))
    assert trust.false_steps.any() and not trust.false_frames.any()


@pytest.mark.parametrize("seed", range(10))
def test_outliers_are_told_from_fast_drift(seed: int) -> None:
    rng = np.random.default_rng(seed)
    slam = _fast_drift(rng)
    for f in (6, 17):
        turn = Rotation.from_rotvec(np.deg2rad(15) * unit(rng.normal(size=3))).as_matrix()
        slam[f] = slam[f] @ pose(turn, 2 * unit(rng.normal(size=3)))
    assert np.flatnonzero(_judge(slam).false_frames).tolist() == [6, 17]


@pytest.mark.parametrize("frames", [(7,), (1,), (4, 15, 20), (9, 10), (9, 11), (3, 4, 6)])
def test_displaced_frames_are_named_and_chained_past(frames: tuple[int, ...]) -> None:
    slam = _slam()
    rng = np.random.default_rng(3)
    for f in frames:
        turn = Rotation.from_rotvec(np.deg2rad(12) * unit(rng.normal(size=3))).as_matrix()
        slam[f] = slam[f] @ pose(turn, 1.5 * unit(rng.normal(size=3)))
    trust = _judge(slam)
    assert tuple(np.flatnonzero(trust.false_frames)) == frames
    steps = inverse(trust.world_T_rigs[:-1]) @ trust.world_T_rigs[1:]
    true = inverse(TRUTH[:-1]) @ TRUTH[1:]
    between = np.swapaxes(steps[:, :3, :3], 1, 2) @ true[:, :3, :3]
    assert np.degrees(rotation_angle(between)).max() < 1.6  # what an unaccused step may be off
    lengths = np.linalg.norm(steps[:, :3, 3], axis=1) / np.linalg.norm(true[:, :3, 3], axis=1)
    assert np.abs(np.log(lengths / np.median(lengths))).max() < 0.3


def test_a_jump_for_good_costs_one_step() -> None:
    slam = _slam()
    slam[12:, :3, 3] += [2.0, 0, 1.0]
    trust = _judge(slam)
    assert np.flatnonzero(trust.false_steps).tolist() == [11]
    assert np.flatnonzero(trust.false_frames).tolist() == [12]


def test_a_step_too_long_in_the_right_direction_is_false() -> None:
    slam = _slam()
    slam[12:, :3, 3] += slam[12, :3, 3] - slam[11, :3, 3]
    assert np.flatnonzero(_judge(slam).false_steps).tolist() == [11]


def test_scale_that_drifts_slowly_is_followed() -> None:
    steps = inverse(TRUTH[:-1]) @ TRUTH[1:]
    steps[:, :3, 3] *= np.linspace(0.7, 1.3, len(steps))[:, None]
    slam = [np.eye(4)]
    for step in steps:
        slam.append(slam[-1] @ step)
    assert _judge(np.array(slam)).sound


def test_guessed_poses_are_not_accused() -> None:
    slam = _slam()
    slam[5, :3, 3] += 3
    trust = _judge(slam, lost=(5,))
    assert trust.false_steps[4:6].all() and not trust.false_frames.any()


def test_what_no_image_shows_stays_with_the_trajectory() -> None:
    slam = _slam()
    slam[3, :3, 3] += 3  # elsewhere, so that the start is chained anew
    trust = _judge(slam, missing=(15,))
    assert np.flatnonzero(trust.unseen_steps).tolist() == [15]
    kept = inverse(trust.world_T_rigs[15]) @ trust.world_T_rigs[16]
    np.testing.assert_allclose(kept, inverse(slam[15]) @ slam[16], atol=1e-9)


def test_lengths_outvote_outliers_and_bridge_what_is_unknown() -> None:
    true = np.exp(0.3 * np.sin(np.arange(40) / 4))
    logs, sigmas = np.diff(np.log(true)), np.full(39, 0.02)
    slam, noise = true.copy(), np.full(40, 0.1)
    slam[[8, 9, 25]] *= [3, 0.2, 5]
    found = step_lengths(slam, noise, logs, sigmas)
    np.testing.assert_allclose(found, true, rtol=0.03)
    sigmas[30] = np.inf
    noise[31:] = np.inf  # nothing known behind the break: the pace goes on
    found = step_lengths(slam, noise, logs, sigmas)
    np.testing.assert_allclose(found[:31], true[:31], rtol=0.03)
    assert found[31] == pytest.approx(found[30], rel=0.01)


def test_a_turn_on_the_spot_is_seen_as_one() -> None:
    """Steps without parallax have rotations only, better than an essential matrix knows them."""
    rng = np.random.default_rng(4)
    bearings0 = unit(rng.normal(size=(NUM_POINTS, 3)))
    turn = Rotation.from_rotvec([0.02, 0.3, 0]).as_matrix()
    bearings = np.concatenate([bearings0, with_noise(bearings0 @ turn, 3e-4, rng)])
    keypoints = keypoints_of(np.array([0, NUM_POINTS, 2 * NUM_POINTS]), bearings, 3e-4)
    rows = np.tile(np.arange(NUM_POINTS, dtype=np.int32)[:, None], (1, 2))
    rough = Rotation.from_rotvec([0.001, 0, 0]).as_matrix()
    f0_T_f1 = pose(turn @ rough, np.array([0.0, 0, 1]))[None]
    matches = Matches(np.array([[0, 1]], np.int32), np.array([0, NUM_POINTS]), rows)
    pairs = VerifiedPairs(matches, f0_T_f1, np.array([np.inf]), Counts(1, 1, "pairs"))
    found = image_steps(pairs, keypoints)
    assert found.verified[0] and not found.directed[0]
    error = np.degrees(rotation_angle(found.f_T_nexts[0, :3, :3].T @ turn))
    assert error < 0.01  # 80 bearings of 0.017 degrees
    slam = np.stack([np.eye(4), pose(np.eye(3), np.array([0.0, 0, 2]))])
    coarse = CoarsePoses(slam, np.full(2, PoseSource.SLAM, np.uint8), 0.0)
    given = coarse, found, np.zeros(0), np.zeros(0), VERIFY, PRIORS
    assert not judgement.check_steps(*given).turning_only  # no parallax is no proof of a turn
    trust = judgement.check_steps(*given, turning.prove(pairs, keypoints, VERIFY))
    assert trust.turning_only and trust.false_steps.all()
    between = trust.world_T_rigs[0, :3, :3].T @ trust.world_T_rigs[1, :3, :3]
    assert np.degrees(rotation_angle(between.T @ turn)) < 0.01


def _over_two_steps(
    f0: int, direction: np.ndarray, sigma: float = 0.0
) -> tuple[VerifiedPairs, Keypoints]:
    """Steps as seen, and a pair over two of them in a direction of its own."""
    pairs, keypoints = _seen()
    f0_T_f2 = inverse(TRUTH[f0]) @ TRUTH[f0 + 2]
    f0_T_f2[:3, 3] = direction
    rows = np.tile(np.arange(NUM_POINTS, dtype=np.int32)[:, None], (1, 2))
    matches = Matches(
        np.concatenate([pairs.matches.pairs, [[f0, f0 + 2]]]).astype(np.int32),
        np.append(pairs.matches.offsets, pairs.matches.offsets[-1] + NUM_POINTS),
        np.concatenate([pairs.matches.keypoints, rows]),
    )
    poses = np.concatenate([pairs.f0_T_f1s, f0_T_f2[None]])
    sigmas = np.append(pairs.direction_sigmas, sigma)
    return VerifiedPairs(matches, poses, sigmas, pairs.counts), keypoints


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0, 4.0])
def test_a_pair_over_two_steps_lies_between_them_whatever_their_lengths(share: float) -> None:
    first, second = (inverse(TRUTH[7:9]) @ TRUTH[8:10])[:, :3, 3]
    turned = inverse(TRUTH[7]) @ TRUTH[8]
    between = unit(unit(first) + share * unit(turned[:3, :3] @ second))
    pairs, keypoints = _over_two_steps(7, between)
    found = image_steps(pairs, keypoints)
    assert off_steps(pairs, found).max() < np.deg2rad(0.01)


@pytest.mark.parametrize("degrees", [1.0, 5.0, 20.0, 120.0])
def test_a_pair_over_two_steps_that_leaves_them_is_as_far_off(degrees: float) -> None:
    first, second = (inverse(TRUTH[7:9]) @ TRUTH[8:10])[:, :3, 3]
    second = (inverse(TRUTH[7]) @ TRUTH[8])[:3, :3] @ second
    middle, normal = unit(unit(first) + unit(second)), unit(np.cross(first, second))
    angle = np.deg2rad(degrees)
    pairs, keypoints = _over_two_steps(7, np.cos(angle) * middle + np.sin(angle) * normal)
    found = image_steps(pairs, keypoints)
    off = off_steps(pairs, found)
    assert off[:-1].max() == 0
    wanted = min(angle, np.arccos(np.cos(angle) * (middle @ unit(first))))
    assert off[-1] == pytest.approx(wanted if degrees < 90 else off[-1], abs=1e-6)
    assert off[-1] > 0.9 * min(angle, np.pi / 2)


@pytest.mark.parametrize("sigma", [np.deg2rad(1.0), np.inf])
def test_a_pair_is_as_far_off_steps_as_its_direction_surely_is(sigma: float) -> None:
    first, second = (inverse(TRUTH[7:9]) @ TRUTH[8:10])[:, :3, 3]
    second = (inverse(TRUTH[7]) @ TRUTH[8])[:3, :3] @ second
    middle, normal = unit(unit(first) + unit(second)), unit(np.cross(first, second))
    angle = np.deg2rad(5.0)
    direction = np.cos(angle) * middle + np.sin(angle) * normal
    pairs, keypoints = _over_two_steps(7, direction, sigma)
    off = off_steps(pairs, image_steps(pairs, keypoints))[-1]
    assert off == pytest.approx(max(angle - 3 * sigma, 0), abs=1e-6)


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize(
    ("seen", "jump", "pause", "expected"),
    [
        (1.0, 1.0, 1.0, False),
        (1.15, 1.0, 1.0, False),
        (1.3, 1.0, 1.0, None),  # only where the step's own frames do not match
        (0.55, 1.0, 1.0, True),  # a bay too short
        (1.8, 1.0, 1.0, True),
        (1.0, 2.0, 1.0, False),  # the trajectory jumps
        (0.2, 1.0, 4.0, True),  # four times as far in a pause of four steps, says the trajectory
    ],
)
def test_of_two_lengths_of_a_step_the_more_usual_speed_is_taken(
    seen: float, jump: float, pause: float, expected: bool | None, known: bool
) -> None:
    """The trajectory's scale drifts by half, besides."""
    step, true = NUM_FRAMES // 2, TRUTH.copy()
    motion = TRUTH[step + 1, :3, 3] - TRUTH[step, :3, 3]
    true[step + 1 :, :3, 3] += (pause - 1) * motion
    slam, found = true.copy(), true.copy()
    slam[step + 1 :, :3, 3] += (jump - 1) * pause * motion
    found[step + 1 :, :3, 3] += (seen - 1) * pause * motion
    drift = np.geomspace(1, 1.5, NUM_FRAMES)[:, None]
    slam[:, :3, 3] = np.cumsum(np.diff(slam[:, :3, 3], axis=0, prepend=0) * drift, 0)
    times = np.arange(NUM_FRAMES) + np.where(np.arange(NUM_FRAMES) > step, pause - 1, 0)
    coarse = CoarsePoses(slam, np.full(NUM_FRAMES, PoseSource.SLAM, np.uint8), 0.0)
    contradicted = (np.arange(NUM_FRAMES - 1) == step) & known
    trust = replace(StepChecks.of_all(found), false_steps=contradicted)
    given = found, times, VERIFY.max_length_ratio, PRIORS.translation
    wrong = judgement.implausible_steps(coarse, trust, *given)
    np.testing.assert_array_equal(np.flatnonzero(wrong), [step] if expected else [])
    after = judgement.without_steps(coarse, trust, wrong)
    steps = [inverse(one[:-1]) @ one[1:] for one in (after.world_T_rigs, found, slam)]
    np.testing.assert_allclose(steps[0], np.where(wrong[:, None, None], *steps[:0:-1]), atol=1e-9)
    assert after.held_steps[step] == bool(expected)
    unseen = replace(trust, unseen_steps=np.arange(NUM_FRAMES - 1) == step)
    wrong = judgement.implausible_steps(coarse, unseen, *given)
    guessed = expected is False or known  # neither images nor the trajectory give it
    np.testing.assert_array_equal(np.flatnonzero(wrong), [] if guessed else [step])
    untracked = replace(coarse, sources=np.full(NUM_FRAMES, PoseSource.INTERPOLATED, np.uint8))
    assert not judgement.implausible_steps(untracked, trust, *given).any()


@pytest.mark.parametrize("interval", [1.0, 2.0])
@pytest.mark.parametrize(
    ("paces", "unusual"), [(1.0, False), (0.7, False), (0.4, True), (2.0, True), (-0.7, True)]
)
def test_a_step_over_missing_frames_is_walked_at_the_usual_pace_or_doubted(
    paces: float, unusual: bool, interval: float
) -> None:
    step, times = NUM_FRAMES // 2, np.arange(NUM_FRAMES, dtype=float)
    times[step + 1 :] += interval - 1
    found = TRUTH.copy()
    motion = TRUTH[step + 1, :3, 3] - TRUTH[step, :3, 3]
    found[step + 1 :, :3, 3] += (paces * interval - 1) * motion
    doubted = judgement.unusual_paces(found, times, np.zeros(NUM_FRAMES, int))
    expected = [step] if unusual and interval > 1 else []
    np.testing.assert_array_equal(np.flatnonzero(doubted), expected)
    other = np.arange(NUM_FRAMES) > step  # a recording of its own
    assert not judgement.unusual_paces(found, times, other.astype(int)).any()


@pytest.mark.parametrize("depths", [0.2, 0.5])
@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("shown", [True, False])
def test_long_steps_back_and_forth_are_doubted_on_both_sides_of_the_frame(
    depths: float, turned: bool, shown: bool
) -> None:
    """One who turns about turns the camera, too; where images show no step, nothing is known."""
    poses, there = np.tile(np.eye(4), (NUM_FRAMES, 1, 1)), NUM_FRAMES // 2
    along = np.arange(NUM_FRAMES, dtype=float)
    along[there + 1 :] = 2 * there - along[there + 1 :]
    poses[:, 2, 3] = along
    if turned:
        poses[there + 1 :, :3, :3] = np.diag([-1.0, 1.0, -1.0])
        poses[there, :3, :3] = np.diag([-1.0, 1.0, -1.0])
    seen = np.ones(NUM_FRAMES - 1, bool)
    seen[there] = shown
    found = judgement.back_and_forth(poses, seen, 1 / depths)
    doubted = depths > 0.3 and not turned and shown
    np.testing.assert_array_equal(np.flatnonzero(found), [there - 1, there] if doubted else [])
    assert judgement.long_steps(poses, 1 / depths).all() == (depths > 0.3)


@pytest.mark.parametrize("first", [0, 9])
def test_images_alone_start_where_a_camera_stands_from_one_place(first: int) -> None:
    truth, stands = TRUTH.copy(), slice(first, first + 8)
    truth[stands, :3, 3] = truth[first, :3, 3]
    pairs, keypoints = _seen(truth=truth)
    found = image_steps(pairs, keypoints)
    assert np.isinf(found.direction_sigmas[first : first + 7]).all()
    nowhere = np.tile(np.eye(4), (NUM_FRAMES, 1, 1))
    nowhere[:, 0, 3] = np.arange(NUM_FRAMES)  # one unit a step
    coarse = CoarsePoses(nowhere, np.full(NUM_FRAMES, PoseSource.NONE, np.uint8), 0.0)
    logs, sigmas = length_ratios(pairs, found, keypoints)
    trust = judgement.check_steps(coarse, found, logs, sigmas, VERIFY, PRIORS)
    lengths = np.linalg.norm(np.diff(trust.world_T_rigs[:, :3, 3], axis=0), axis=1)
    standing = np.zeros(NUM_FRAMES - 1, bool)
    standing[first : first + 7] = True
    assert lengths[standing].max() < 0.02 * np.median(lengths[~standing])


def test_a_camera_that_stands_does_not_go_back() -> None:
    poses = np.tile(np.eye(4), (NUM_FRAMES, 1, 1))
    stands = slice(NUM_FRAMES // 2, NUM_FRAMES // 2 + 4)
    poses[:, 2, 3] = np.arange(NUM_FRAMES)
    poses[stands, 2, 3] = stands.start + 1e-3 * np.array([0.0, -1.0, 1.0, -1.0])
    assert not judgement.back_and_forth(poses, np.ones(NUM_FRAMES - 1, bool), 1.0).any()
