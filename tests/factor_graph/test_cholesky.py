"""Sparse Cholesky and conjugate gradients on 6x6 blocks, beside dense algebra."""

import numpy as np
import pytest

from factors.cholesky import BlockCholesky
from factors.iterative_system import conjugate_gradients, multiply_blocks
from factors.supernodes import find_supernodes

Pairs = list[tuple[int, int]]


def _random(num: int) -> Pairs:
    rng = np.random.default_rng(7)
    return [(i, k) for i in range(num) for k in range(i + 1, num) if rng.random() < 0.15]


PATTERNS: dict[str, tuple[int, Pairs]] = {
    "random": (30, _random(30)),
    "full": (12, [(i, k) for i in range(12) for k in range(i + 1, 12)]),
    "a chain": (40, [(i, k) for i in range(40) for k in range(i + 1, min(i + 4, 40))]),
    "a ring": (40, [(i, i + 1) for i in range(39)] + [(0, 39)]),
    "a star": (15, [(0, k) for k in range(1, 15)]),
    "two parts and a lone block": (9, [(0, 3), (3, 5), (1, 2), (2, 6), (1, 7)]),
    "no pairs": (4, []),
    "one block": (1, []),
}


class System:
    """A diagonally dominant system of a pattern, in blocks and whole."""

    def __init__(self, pattern: str) -> None:
        self.num, pairs = PATTERNS[pattern]
        self.pairs = np.array(pairs, np.int64).reshape(-1, 2)
        rng = np.random.default_rng(1)
        self.off_diagonal = rng.normal(size=(len(pairs), 6, 6))
        dense = np.zeros((self.num, 6, self.num, 6))
        for (i, k), block in zip(pairs, self.off_diagonal, strict=True):
            dense[i, :, k, :], dense[k, :, i, :] = block, block.T
        self.diagonal = np.tile(60 * np.eye(6), (self.num, 1, 1))
        dense[np.arange(self.num), :, np.arange(self.num), :] = self.diagonal
        self.matrix = dense.reshape(6 * self.num, 6 * self.num)
        self.right = rng.normal(size=(self.num, 6))


@pytest.mark.parametrize("pattern", PATTERNS)
def test_cholesky_solves_inverts_and_draws(pattern: str) -> None:
    system = System(pattern)
    num, pairs = system.num, system.pairs
    cholesky = BlockCholesky(num, pairs)
    assert not cholesky.factorize(-system.diagonal, system.off_diagonal)
    assert cholesky.factorize(system.diagonal, system.off_diagonal)
    solution = cholesky.solve(system.right)
    assert np.allclose(system.matrix @ solution.ravel(), system.right.ravel(), atol=1e-12)
    rights = np.random.default_rng(2).normal(size=(3, num, 6))
    each = [cholesky.solve(right) for right in rights]
    np.testing.assert_allclose(cholesky.solve_all(rights), each, atol=1e-14)
    inverse = np.linalg.inv(system.matrix).reshape(num, 6, num, 6)
    both = np.concatenate([pairs, pairs[:, ::-1]])
    on_diagonal, between = cholesky.inverse_blocks(both)
    expected = inverse[np.arange(num), :, np.arange(num), :]
    assert np.allclose(on_diagonal, expected, atol=1e-14)
    assert np.allclose(between, inverse[both[:, 0], :, both[:, 1], :], atol=1e-14)
    roots = cholesky.draw(np.eye(6 * num).reshape(-1, num, 6)).reshape(6 * num, -1)
    assert np.allclose(roots.T @ roots, inverse.reshape(6 * num, -1), atol=1e-14)


@pytest.mark.parametrize("pattern", PATTERNS)
def test_supernodes_hold_the_fill_of_plain_elimination(pattern: str) -> None:
    num, pairs = PATTERNS[pattern]
    runs = find_supernodes(num, np.array(pairs, np.int64).reshape(-1, 2))
    assert sorted(runs.order) == list(range(num))
    place = np.argsort(runs.order)
    left = {(min(place[i], place[k]), max(place[i], place[k])) for i, k in pairs}
    for column in range(num):
        below = sorted(k for i, k in left if i == column)
        left |= {(i, k) for a, i in enumerate(below) for k in below[a + 1 :]}
    held = set()
    for s, rows in enumerate(runs.rows):
        columns = range(runs.starts[s], runs.starts[s + 1])
        held |= {(i, k) for i in columns for k in (*columns, *rows) if i < k}
        assert (runs.parents[s] == -1) == (len(rows) == 0)
        if len(rows):
            parent = runs.parents[s]
            known = {*range(runs.starts[parent], runs.starts[parent + 1]), *runs.rows[parent]}
            assert parent > s and set(rows) <= known
    assert left <= held


def test_conjugate_gradients_reach_the_solution_and_say_what_is_left() -> None:
    system = System("random")
    inverses = np.linalg.inv(system.diagonal)

    def times(x: np.ndarray) -> np.ndarray:
        return multiply_blocks(system.diagonal, system.off_diagonal, system.pairs, x)

    right = np.stack([system.right, system.right[::-1]], axis=2)
    given = times, right, lambda x: inverses @ x
    found = conjugate_gradients(*given, 1e-12, 100)
    assert found is not None
    x, residual = found
    assert np.allclose(system.matrix @ flat(x), flat(right), atol=1e-10)
    rough = conjugate_gradients(*given, 1e-2, 100)
    left = flat(right) - system.matrix @ flat(rough[0])
    assert np.allclose(flat(rough[1]), left, atol=1e-12)
    assert np.linalg.norm(residual) < np.linalg.norm(left) < 0.1 * np.linalg.norm(right)
    assert conjugate_gradients(*given, 1e-12, 2) is None
    short = conjugate_gradients(*given, 1e-12, 2, truncate=True)
    assert np.allclose(flat(short[1]), flat(right) - system.matrix @ flat(short[0]), atol=1e-12)
    model = 0.5 * flat(short[0]) * (system.matrix @ flat(short[0])) - flat(short[0]) * flat(right)
    assert np.all(model.sum(axis=0) < 0)  # lower than where nothing is done
    assert conjugate_gradients(lambda x: -times(x), *given[1:], 1e-2, 100) is None
    nothing = conjugate_gradients(times, 0 * right, given[2], 1e-2, 100)
    assert nothing is not None and not np.any(nothing[0])


def flat(x: np.ndarray) -> np.ndarray:
    """Vectors (6 N, R) of (N, 6, R)."""
    return x.reshape(-1, x.shape[2])


@pytest.mark.parametrize("num_kept", [1, 3])
@pytest.mark.parametrize("pattern", [name for name, (num, _) in PATTERNS.items() if num > 3])
def test_blocks_that_are_kept_get_the_schur_complement(pattern: str, num_kept: int) -> None:
    system = System(pattern)
    cut = system.num - num_kept
    cholesky = BlockCholesky(system.num, system.pairs, num_kept)
    assert cholesky.factorize(system.diagonal, system.off_diagonal)
    H, right = system.matrix, system.right.ravel()
    inner, outer = slice(0, 6 * cut), slice(6 * cut, None)
    across = np.linalg.solve(H[inner, inner], H[inner, outer]).T
    expected = H[outer, outer] - across @ H[inner, outer]
    np.testing.assert_allclose(np.tril(cholesky.complement), np.tril(expected), atol=1e-11)
    reduced = cholesky.reduced(system.right)
    np.testing.assert_allclose(reduced.ravel(), right[outer] - across @ right[inner], atol=1e-12)
    solution = np.linalg.solve(H, right).reshape(-1, 6)
    found = cholesky.substituted(system.right, solution[cut:])
    np.testing.assert_allclose(found, solution, atol=1e-13)
