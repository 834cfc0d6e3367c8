"""The model of errors that last: against its dense covariance, and against draws."""

import numpy as np
import pytest
from lasting_errors import SIGMAS_M, TAU_S, covariance, fixes_at, lasting_errors


@pytest.mark.parametrize("seed", range(3))
def test_whitening_weighs_with_the_inverse_covariance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.exponential(20.0, 30))
    columns = rng.normal(size=(30, 3, 4))
    white = fixes_at(np.zeros((30, 3)), times).whitened(columns)
    inverse = np.linalg.inv(covariance(times))
    for axis in range(3):
        wanted = columns[:, axis].T @ inverse @ columns[:, axis] / SIGMAS_M[axis] ** 2
        np.testing.assert_allclose(white[:, axis].T @ white[:, axis], wanted, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("every_s", [0.1, 1.0, 30.0, 600.0])
def test_independent_errors_say_as_much_of_a_mean(every_s: float) -> None:
    """Over a walk of thirty time constants; those of its ends are what is off."""
    times = np.arange(0, 30 * TAU_S + every_s, every_s)
    fixes = fixes_at(np.zeros((len(times), 3)), times)
    claimed = 1 / np.sum(1 / fixes.independent_sigmas() ** 2, axis=0)
    exact = covariance(times).mean() * SIGMAS_M**2
    np.testing.assert_allclose(claimed, exact, rtol=0.05)


def test_draws_are_of_the_model() -> None:
    times = np.arange(0, 4000 * TAU_S, 30.0)
    errors = lasting_errors(times, np.random.default_rng(0))
    np.testing.assert_allclose(errors.std(axis=0), SIGMAS_M, rtol=0.05)
    white = fixes_at(errors, times).whitened(errors)
    np.testing.assert_allclose(white.std(axis=0), 1, atol=0.03)
    neighbours = np.mean(white[1:] * white[:-1], axis=0)
    np.testing.assert_allclose(neighbours, 0, atol=0.05)


def test_fixes_without_times_are_neither_alike_nor_independent() -> None:
    alone = fixes_at(np.zeros((400, 3)), None)
    claimed = np.sqrt(1 / np.sum(1 / alone.independent_sigmas() ** 2, axis=0))
    assert np.all(claimed > 1.5 * SIGMAS_M / 20) and np.all(claimed < 5 * SIGMAS_M / 20)
    one = fixes_at(np.zeros((1, 3)), None)
    np.testing.assert_array_equal(one.independent_sigmas(), [SIGMAS_M])


def test_false_fixes_cannot_widen_the_gate() -> None:
    """However many are false: a gate as wide as their median would take all."""
    num, rng = 20, np.random.default_rng(4)
    fixes = fixes_at(np.zeros((num, 3)), None)
    off = SIGMAS_M * rng.normal(size=(num, 3))
    used, scatter = fixes.inliers(off, 100.0)
    assert used.all() and scatter < 1.5
    noisy, scatter = fixes.inliers(3 * off, 100.0)  # as in streets
    assert noisy.all() and 2 < scatter < 3.5
    off[:8] += [500.0, 0, 0]
    used, _ = fixes.inliers(off, 100.0)
    assert not used[:8].any() and used[8:].all()
    off[:12] += [500.0, 0, 0]
    used, scatter = fixes.inliers(off, 100.0)
    assert not used[:12].any() and used.sum() <= num / 2 and scatter < 4
