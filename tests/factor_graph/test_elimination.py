"""Landmarks eliminated with whatever frames have, against the whole problem written out."""

import numpy as np
import pytest

from factors.elimination import LinearSystem, eliminate

FRAMES, POINTS, OWN, SHARED = 5, 12, 7, 3


def _problem(seed: int) -> tuple[np.ndarray, ...]:
    """Observations in any order; points 0 and 1 are told by one and two of them."""
    rng = np.random.default_rng(seed)
    seen = rng.random((POINTS, FRAMES)) < 0.7
    seen[0], seen[1] = [True, *[False] * 4], [True, True, *[False] * 3]
    seen[2:, :2] = True
    points, frames = np.nonzero(seen)
    order = rng.permutation(len(points))
    shapes = ((2,), (2, 3), (2, OWN), (2, SHARED))
    parts = (rng.normal(size=(len(order), *shape)) for shape in shapes)
    return frames[order], points[order], *parts


def _dense(frames, points, residuals, by_point, by_frame, by_shared) -> LinearSystem:
    """The same by the pseudo-inverse of the points' own Jacobian."""
    num, size = 2 * len(frames), FRAMES * OWN
    left, right = np.zeros((num, 3 * POINTS)), np.zeros((num, size + SHARED))
    for o, (f, p) in enumerate(zip(frames, points, strict=True)):
        rows = slice(2 * o, 2 * o + 2)
        left[rows, 3 * p : 3 * p + 3] = by_point[o]
        right[rows, OWN * f : OWN * (f + 1)] = by_frame[o]
        right[rows, size:] = by_shared[o]
    rest = np.eye(num) - left @ np.linalg.pinv(left)
    r = residuals.ravel()
    return LinearSystem(0.5 * r @ rest @ r, right.T @ rest @ r, right.T @ rest @ right)


@pytest.mark.parametrize("seed", range(3))
def test_it_is_the_schur_complement(seed: int) -> None:
    problem = _problem(seed)
    found, expected = eliminate(FRAMES, *problem).system(), _dense(*problem)
    assert found.cost == pytest.approx(expected.cost)
    np.testing.assert_allclose(found.gradient, expected.gradient, atol=1e-7)
    np.testing.assert_allclose(found.hessian.toarray(), expected.hessian, atol=1e-7)


def test_nothing_need_be_shared() -> None:
    frames, points, *parts, shared = _problem(0)
    found = eliminate(FRAMES, frames, points, *parts, np.zeros((len(frames), 2, 0))).system()
    whole = _dense(frames, points, *parts, shared)
    size = FRAMES * OWN
    np.testing.assert_allclose(found.hessian.toarray(), whole.hessian[:size, :size], atol=1e-7)


def test_a_point_upon_a_camera_does_no_harm() -> None:
    """One observation outweighs all others ten million times: nothing negative is left of it."""
    frames, points, residuals, by_point, by_frame, by_shared = _problem(1)
    near = np.flatnonzero((points == 5) & (frames == 0))
    by_point[near], by_frame[near] = 1e7 * by_point[near], 1e7 * by_frame[near]
    sums = eliminate(FRAMES, frames, points, residuals, by_point, by_frame, by_shared)
    hessian = sums.system().hessian.toarray()
    np.testing.assert_array_equal(hessian, hessian.T)
    eigenvalues = np.linalg.eigvalsh(hessian)
    assert eigenvalues.min() > -1e-14 * eigenvalues.max()
