"""Two-view verification: the pose among outliers, and the trajectory's veto."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic import bearings_of, keypoints_of, unit, with_noise

from gsba.geometry import pose, rotation_angle
from gsba.matching import verification
from gsba.store.shards import Threads
from gsba.trajectory.limits import TwoViewLimits
from gsba.types import Matches, VerifiedPairs

NUM = 200
SIGMA = 3e-4
SETTINGS = TwoViewLimits()
F0_T_F1 = pose(Rotation.from_rotvec([0.05, 0.4, -0.02]).as_matrix(), np.array([0.4, 0.05, 0.6]))


def _see(
    f0_T_f1: np.ndarray, outliers: float, seed: int = 0, num: int = NUM
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Bearings (N, 3) of matches in both frames, and which matches are true."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(2, 8, (num, 1)) * unit(rng.normal(size=(num, 3)))
    bearings0 = with_noise(unit(points), SIGMA, rng)
    bearings1 = with_noise(bearings_of(points, f0_T_f1), SIGMA, rng)
    true = rng.random(num) >= outliers
    bearings1[~true] = unit(rng.normal(size=((~true).sum(), 3)))
    return bearings0, bearings1, true


def _direction_error(found: np.ndarray, true: np.ndarray) -> float:
    return np.degrees(np.arccos(np.clip(unit(found[:3, 3]) @ unit(true[:3, 3]), -1, 1)))


@pytest.mark.parametrize("seed", range(3))
def test_the_pose_is_found_among_outliers(seed: int) -> None:
    bearings0, bearings1, true = _see(F0_T_F1, 0.4, seed)
    estimate = verification.relative_pose(bearings0, bearings1, SETTINGS, 0)
    found, inliers = estimate.f0_T_f1, estimate.inliers
    # 120 bearings of 0.017 degrees with some 10 degrees of parallax.
    assert np.degrees(rotation_angle(found[:3, :3].T @ F0_T_F1[:3, :3])) < 0.05
    assert _direction_error(found, F0_T_F1) < 0.3
    assert np.linalg.norm(found[:3, 3]) == pytest.approx(1)
    assert inliers[true].mean() > 0.98
    # A random bearing lies within 0.25 degrees of an epipolar line one time in 200.
    assert inliers[~true].sum() <= 4


def test_five_matches_prove_nothing() -> None:
    bearings0, bearings1, _ = _see(F0_T_F1, 0.0)
    assert verification.relative_pose(bearings0[:5], bearings1[:5], SETTINGS, 0) is None


@pytest.mark.parametrize("num", [10, 50, 200, 1000])
def test_chance_makes_no_pose(num: int) -> None:
    for seed in range(10):
        noise0, noise1, _ = _see(F0_T_F1, 1.0, seed, num)
        assert verification.relative_pose(noise0, noise1, SETTINGS, seed) is None


@pytest.mark.parametrize("seed", range(3))
def test_a_minority_that_chance_does_not_explain_is_believed(seed: int) -> None:
    bearings0, bearings1, _ = _see(F0_T_F1, 0.7, seed, 400)
    found = verification.relative_pose(bearings0, bearings1, SETTINGS, 0, rivals=True)
    assert found is not None and not found.rivalled
    assert _direction_error(found.f0_T_f1, F0_T_F1) < 1.0


def test_matches_of_one_spot_are_one_witness() -> None:
    """Two hundred matches on a poster some degrees wide fit many poses."""
    rng = np.random.default_rng(0)
    points = np.array([0, 0, 5.0]) + rng.uniform(-0.15, 0.15, (NUM, 3))
    bearings0 = with_noise(unit(points), SIGMA, rng)
    bearings1 = with_noise(bearings_of(points, F0_T_F1), SIGMA, rng)
    assert verification.relative_pose(bearings0, bearings1, SETTINGS, 0) is None


def test_what_the_search_let_pass_proves_less() -> None:
    """A search along predicted directions makes false matches agree with poses near by."""
    bearings0, bearings1, _ = _see(F0_T_F1, 0.7, num=100)
    found = [
        verification.relative_pose(bearings0, bearings1, SETTINGS, 0, chance)
        for chance in (0.0, 0.5)
    ]
    assert found[0] is not None and found[1] is None


def _two_poses(support: float) -> tuple[np.ndarray, np.ndarray]:
    """Matches of which a share agrees with one pose, and the rest with another."""
    other = pose(Rotation.from_rotvec([0, -0.6, 0]).as_matrix(), np.array([-0.5, 0, 0.5]))
    num = round(support * NUM)
    one, two = _see(F0_T_F1, 0.0, 0, num), _see(other, 0.0, 1, NUM - num)
    bearings0, bearings1 = (np.concatenate([one[n], two[n]]) for n in (0, 1))
    return bearings0, bearings1


@pytest.mark.parametrize(("support", "rivalled"), [(0.5, True), (0.53, True), (0.75, False)])
def test_a_pose_must_outweigh_another(support: float, rivalled: bool) -> None:
    found = verification.relative_pose(*_two_poses(support), SETTINGS, 0, rivals=True)
    assert found is not None and found.rivalled is rivalled


@pytest.mark.parametrize("seed", range(10))
def test_turning_is_told_from_walking(seed: int) -> None:
    """Whatever noise there is: parallax is known by what a rotation leaves over."""
    for baseline in (0.0, 0.3):
        f0_T_f1 = F0_T_F1.copy()
        f0_T_f1[:3, 3] *= baseline
        bearings0, bearings1, _ = _see(f0_T_f1, 0.3, seed, 400)
        found = verification.relative_pose(bearings0, bearings1, SETTINGS, 0)
        assert found is not None and np.isfinite(found.direction_sigma) == (baseline > 0)


def test_directions_are_as_sure_as_they_say() -> None:
    errors = []
    for seed in range(30):
        bearings0, bearings1, _ = _see(F0_T_F1, 0.2, seed)
        found = verification.relative_pose(bearings0, bearings1, SETTINGS, 0)
        angle = np.deg2rad(_direction_error(found.f0_T_f1, F0_T_F1))
        errors.append(angle / found.direction_sigma)
    # Bearings of one ideal centre: less noise than the model of lenses allows for.
    assert 0.05 < np.sqrt(np.mean(np.square(errors))) < 1.5


def _run(
    views: list[tuple[np.ndarray, np.ndarray, np.ndarray]],
    priors: list[np.ndarray],
    sigmas: list[float] | None = None,
) -> VerifiedPairs:
    """Each view as a pair of two frames of its own, keypoint k matched with k."""
    bearings = np.concatenate([np.zeros((0, 3)), *(b for view in views for b in view[:2])])
    starts = np.cumsum([0] + [len(b) for view in views for b in view[:2]])
    keypoints = keypoints_of(starts, bearings, SIGMA)
    rows = [np.repeat(np.arange(len(view[0]), dtype=np.int32)[:, None], 2, 1) for view in views]
    matches = Matches(
        np.arange(2 * len(views), dtype=np.int32).reshape(-1, 2),
        np.cumsum([0, *map(len, rows)]),
        np.concatenate([np.zeros((0, 2), np.int32), *rows]),
    )
    spread = np.zeros(len(views)) if sigmas is None else np.array(sigmas)
    found = verification.estimate_relative_poses(
        matches, keypoints, SETTINGS, 0, Threads(1), np.zeros(len(views))
    )
    return verification.agree_with_prior(matches, found, np.array(priors), spread, SETTINGS)


def _turned(f0_T_f1: np.ndarray, degrees: float) -> np.ndarray:
    out = f0_T_f1.copy()
    out[:3, :3] = Rotation.from_rotvec([0, np.deg2rad(degrees), 0]).as_matrix() @ out[:3, :3]
    return out


def _redirected(f0_T_f1: np.ndarray, degrees: float) -> np.ndarray:
    out = f0_T_f1.copy()
    axis = unit(np.cross(out[:3, 3], [1.0, 2.0, 3.0]))
    out[:3, 3] = Rotation.from_rotvec(np.deg2rad(degrees) * axis).apply(out[:3, 3])
    return out


def test_pairs_that_agree_with_the_prior_are_kept() -> None:
    views = [_see(F0_T_F1, 0.3), _see(F0_T_F1, 1.0), _see(F0_T_F1, 0.1, seed=1)]
    found = _run(views, [F0_T_F1] * 3)
    np.testing.assert_array_equal(found.matches.pairs, [[0, 1], [4, 5]])
    assert (found.counts.received, found.counts.kept) == (3, 2)
    assert found.counts.dropped["too few matches"] == 1
    for row, view in enumerate((views[0], views[2])):
        kept = found.matches.of(row)
        assert view[2][kept[:, 0]].mean() > 0.97
        assert _direction_error(found.f0_T_f1s[row], F0_T_F1) < 0.3


@pytest.mark.parametrize(
    ("part", "change", "limit"),
    [
        ("rotation", _turned, SETTINGS.max_rotation_deg),
        ("direction", _redirected, SETTINGS.max_direction_deg),
    ],
)
def test_contradictions_are_vetoed(part: str, change, limit: float) -> None:
    priors = [change(F0_T_F1, angle) for angle in (0.8 * limit, 1.2 * limit, 180)]
    found = _run([_see(F0_T_F1, 0.2)] * 3, priors)
    np.testing.assert_array_equal(found.matches.pairs, [[0, 1]])
    assert found.counts.dropped[f"{part} contradicts"] == 2


def test_direction_counts_for_as_much_as_the_prior_knows_it() -> None:
    limit, length = SETTINGS.max_direction_deg, np.linalg.norm(F0_T_F1[:3, 3])
    prior = _redirected(F0_T_F1, 1.5 * limit)
    certain, vague, ignorant = 0.0, length * np.sin(np.deg2rad(0.6 * limit)) / 3, length / 2
    views = [_see(F0_T_F1, 0.2)] * 4
    found = _run(
        views,
        [prior, prior, prior, _redirected(F0_T_F1, 180)],
        [certain, vague, ignorant, ignorant],
    )
    np.testing.assert_array_equal(found.matches.pairs[:, 0] // 2, [1, 2, 3])


@pytest.mark.parametrize("baseline", [0.0, 0.01])
def test_a_standing_camera_has_no_direction_to_veto(baseline: float) -> None:
    still = F0_T_F1.copy()
    still[:3, 3] *= baseline
    found = _run([_see(still, 0.2)], [_redirected(F0_T_F1, 180)])
    assert found.counts.kept == 1
    assert np.isfinite(found.f0_T_f1s).all()


def test_no_pairs_are_no_error() -> None:
    view = _see(F0_T_F1, 0.0)
    for views, priors in (
        ([], np.zeros((0, 4, 4))),
        ([(view[0][:5], view[1][:5], None)], [F0_T_F1]),
    ):
        found = _run(views, priors)
        assert found.counts.kept == 0
        assert found.matches.keypoints.shape == (0, 2) and found.f0_T_f1s.shape == (0, 4, 4)
        np.testing.assert_array_equal(found.matches.offsets, [0])


def test_the_seed_decides() -> None:
    bearings0, bearings1, _ = _see(F0_T_F1, 0.4)
    first, again = (verification.relative_pose(bearings0, bearings1, SETTINGS, 7) for _ in range(2))
    np.testing.assert_array_equal(first.f0_T_f1, again.f0_T_f1)
