"""How well images hold a map, and what that leaves for the trajectory to say."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic import drifted, loop_walk, unit

from gsba.bundle import map_strength
from gsba.bundle.families import Families
from gsba.bundle.map_strength import MapStrength
from gsba.bundle.trajectory_prior import StepNoise, TrajectoryPrior
from gsba.config import RefineSettings
from gsba.geometry import inverse, rotation_angle, step_covariances
from gsba.similarity import similarity
from gsba.types import Counts, JointErrors, Solution

NUM = 24
POSES = loop_walk(NUM)
LENGTHS = np.linalg.norm(np.diff(POSES[:, :3, 3], axis=0), axis=1)
SETTINGS = RefineSettings()
CLOSER, PRIORS = SETTINGS.weak_frames, SETTINGS.priors
ALL = np.ones(NUM - 1, bool)
LOOSE_AT_10 = np.where(np.arange(NUM - 2) == 9, 2e-3, 4e-4)  # sigmas of a chain, frame 10 loose


def _chained(scale_sigma: np.ndarray, num_draws: int = 2000) -> tuple[np.ndarray, JointErrors]:
    """Errors of a chain whose scale changes by chance from each step to the next (F - 2,)."""
    rng = np.random.default_rng(0)
    logs = np.cumsum(scale_sigma * rng.normal(size=(num_draws, NUM - 2)), axis=1)
    stretched = np.diff(POSES[:, :3, 3], axis=0)[1:] * logs[..., None]
    positions = np.concatenate([np.zeros((num_draws, 2, 3)), np.cumsum(stretched, axis=1)], axis=1)
    draws = np.zeros((num_draws, NUM, 6))
    draws[..., 3:] = np.einsum("fji,dfj->dfi", POSES[:, :3, :3], positions)
    draws += 1e-6 * rng.normal(size=draws.shape)
    between = np.einsum("dfi,dfj->fij", draws[:, :-1], draws[:, 1:]) / num_draws
    return np.einsum("dfi,dfj->fij", draws, draws) / num_draws, JointErrors(between, draws)


def _measured(scale_sigma: np.ndarray, coarse: np.ndarray = POSES) -> MapStrength:
    return map_strength.measure(POSES, _chained(scale_sigma), coarse, ALL, ALL, SETTINGS)


def test_a_map_that_hardly_drifts_is_left_alone() -> None:
    errors = _chained(np.full(NUM - 2, 2e-3))
    given = POSES, ALL, ALL
    loose = map_strength.measure(POSES, errors, *given, SETTINGS)
    assert loose.drift[0] > CLOSER.max_drift and loose.weak.any()
    calm = CLOSER.model_copy(update={"max_drift": 2 * loose.drift[0]})
    settings = SETTINGS.model_copy(update={"weak_frames": calm})
    found = map_strength.measure(POSES, errors, *given, settings)
    assert not found.weak.any() and found.held_steps.all()


def test_drift_is_what_is_left_after_the_best_similarity() -> None:
    _, joint = _chained(np.full(NUM - 2, 2e-3), 200)
    draws = joint.draws
    moved = POSES[:, :3, 3] + np.einsum("fij,dfj->dfi", POSES[:, :3, :3], draws[..., 3:])
    squares = []
    for positions in moved:
        fit = similarity(positions, POSES[:, :3, 3])
        squares.append((fit.points(positions) - POSES[:, :3, 3]) ** 2)
    wanted = np.sqrt(3 * np.mean(squares)) / LENGTHS.sum()
    one = np.zeros(NUM, np.int64)
    assert map_strength._drift(POSES, draws, one) == pytest.approx(wanted, rel=0.01)


def test_a_place_walked_twice_is_judged_as_if_it_were_walked_once() -> None:
    errors = _chained(np.full(NUM - 2, 2e-3))
    twice = np.concatenate([POSES, POSES])
    draws = np.concatenate([errors[1].draws, errors[1].draws], axis=1)
    recordings = np.repeat([0, 1], NUM)
    alone = map_strength._drift(POSES, errors[1].draws, recordings[:NUM])
    assert map_strength._drift(twice, draws, recordings) == pytest.approx(alone)


def test_changes_of_scale_are_as_uncertain_as_they_were_made() -> None:
    made = np.linspace(2e-4, 1e-3, NUM - 2)
    assert _measured(made).scale_sigmas == pytest.approx(made, rel=0.1)  # of 2000 draws: 1.6 %


def test_a_place_above_the_limit_is_weak_with_the_frames_around_it() -> None:
    assert np.flatnonzero(_measured(LOOSE_AT_10).weak).tolist() == [8, 9, 10, 11, 12]


def test_nothing_is_looked_for_where_no_image_shows_a_step() -> None:
    seen = ALL.copy()
    seen[10] = False
    found = map_strength.measure(POSES, _chained(LOOSE_AT_10), POSES, seen, ALL, SETTINGS)
    assert not found.weak.any() and not found.held_steps[10]


def test_a_trajectory_that_is_not_believed_leaves_weak_places_to_be_found() -> None:
    found = map_strength.measure(POSES, _chained(LOOSE_AT_10), POSES, ALL, ~ALL, SETTINGS)
    assert found.weak.any() and found.noise is None


def test_steps_that_images_hold_far_better_than_priors_go_without() -> None:
    found = _measured(np.full(NUM - 2, 3e-4))
    assert found.held_steps.all()
    dropped = {"images hold the step far better": NUM - 1}
    assert found.counts == Counts(NUM - 1, 0, "priors on steps", dropped)
    loose = np.full(NUM - 2, 3e-4)
    loose[11] = 0.2  # all lengths behind it
    assert _measured(loose).held_steps.tolist() == [True] * 12 + [False] * 11


def test_the_noise_of_a_trajectory_is_read_from_held_steps() -> None:
    rng, sigmas = np.random.default_rng(1), (0.004, 0.02, 0.03)
    num = 4000
    found = np.tile(np.eye(4), (num, 1, 1))
    steps = found.copy()
    steps[1:, :3, 3] = unit(rng.normal(size=(num - 1, 3)))
    coarse = steps.copy()
    turns = Rotation.from_rotvec(sigmas[0] * rng.normal(size=(num, 3))).as_matrix()
    coarse[:, :3, :3] = turns
    moves = steps[:, :3, 3]
    across = rng.normal(size=(num, 3))
    across -= moves * np.einsum("fi,fi->f", across, moves)[:, None]
    coarse[:, :3, 3] = np.exp(sigmas[2] * rng.normal(size=(num, 1))) * (moves + sigmas[1] * across)
    noise = map_strength._noise(_chain(steps), _chain(coarse), np.ones(num - 1, bool), PRIORS)
    found = [noise.rotation, noise.direction, noise.length]
    assert found == pytest.approx(sigmas, rel=0.1)  # medians of 4000
    few = np.arange(num - 1) < 5
    assert map_strength._noise(_chain(steps), _chain(coarse), few, PRIORS) is None


def _chain(steps: np.ndarray) -> np.ndarray:
    poses = [np.eye(4)]
    for step in steps[1:]:
        poses.append(poses[-1] @ step)
    return np.array(poses)


def test_the_covariance_of_a_step_is_that_of_drawn_steps() -> None:
    covariances, joint = _chained(np.full(NUM - 2, 1e-3))
    found = step_covariances(POSES, covariances, joint.neighbours)
    moved = POSES @ _exponential(joint.draws)
    steps = inverse(POSES[:-1]) @ POSES[1:]
    off = inverse(steps) @ inverse(moved[:, :-1]) @ moved[:, 1:]
    drawn = np.einsum("dfi,dfj->fij", off[..., :3, 3], off[..., :3, 3]) / len(off)
    scale = np.abs(drawn).max()
    assert np.abs(found[:, 3:, 3:] - drawn).max() < 0.02 * scale


def _exponential(tangents: np.ndarray) -> np.ndarray:
    """Poses of small tangents, to first order in the translation."""
    out = np.tile(np.eye(4), (*tangents.shape[:-1], 1, 1))
    turns = Rotation.from_rotvec(tangents[..., :3].reshape(-1, 3)).as_matrix()
    out[..., :3, :3] = turns.reshape(*tangents.shape[:-1], 3, 3)
    out[..., :3, 3] = tangents[..., 3:]
    return out


def test_priors_of_steps_in_a_row_count_as_one_that_drifts() -> None:
    """The length of k steps is known as badly as one is: their drift has one sign."""
    noise, kept = StepNoise(0.01, 0.02, 0.03), np.zeros(NUM - 1, bool)
    kept[[3, 4, 5, 9]] = True
    prior = TrajectoryPrior(POSES, PRIORS, ~kept, np.ones(NUM, bool), noise=noise)
    built = prior.graph(Families().snapshot(Solution.without_points(POSES)))
    steps = [built.at(i) for i in range(built.size()) if len(built.at(i).keys()) == 2]
    assert len(steps) == 4
    for factor, (f, times) in zip(steps, {3: 3, 4: 3, 5: 3, 9: 1}.items(), strict=True):
        covariance = factor.noiseModel().noise().covariance() / times  # type: ignore
        ahead = POSES[f + 1, :3, :3].T @ (POSES[f + 1, :3, 3] - POSES[f, :3, 3])
        length, along = max(LENGTHS[f], np.median(LENGTHS)), ahead / np.linalg.norm(ahead)
        assert along @ covariance[3:, 3:] @ along == pytest.approx((length * noise.length) ** 2)
        trace = (2 * noise.direction**2 + noise.length**2) * length**2
        assert np.trace(covariance[3:, 3:]) == pytest.approx(trace)
        assert covariance[:3, :3] == pytest.approx(noise.rotation**2 * np.eye(3))


def test_a_drifting_trajectory_is_as_noisy_as_it_drifts() -> None:
    coarse = drifted(POSES, np.random.default_rng(0))
    noise = _measured(np.full(NUM - 2, 3e-4), coarse).noise
    steps, given = (inverse(some[:-1]) @ some[1:] for some in (POSES, coarse))
    turned = rotation_angle(np.swapaxes(given[:, :3, :3], 1, 2) @ steps[:, :3, :3])
    assert 0.5 < noise.rotation / np.sqrt(np.mean(turned**2) / 3) < 2
