"""Parts of a map: their size, what they own, and that nothing ties them but frames on cuts."""

import numpy as np
import pytest

from gsba.parts.partition import Partition, partition


def grid(side: int) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of neighbours, and positions, of a square grid of frames."""
    number = np.arange(side * side).reshape(side, side)
    pairs = [np.column_stack([number[:, :-1].ravel(), number[:, 1:].ravel()])]
    pairs.append(np.column_stack([number[:-1].ravel(), number[1:].ravel()]))
    x, y = np.divmod(np.arange(side * side), side)
    return np.concatenate(pairs), np.column_stack([x, 0 * x, y]).astype(float)


def chain(num: int, reach: int) -> np.ndarray:
    """Pairs of frames of a walk that see each other, up to `reach` frames apart."""
    return np.concatenate(
        [np.column_stack([np.arange(num - k), np.arange(k, num)]) for k in range(1, reach + 1)]
    )


def check(cut: Partition, pairs: np.ndarray, most: int) -> None:
    """Parts are small, and no pair ties two of them."""
    own = ~cut.on_cut
    assert np.bincount(cut.homes[own]).max() <= most
    both = own[pairs].all(axis=1)
    assert (cut.homes[pairs[both, 0]] == cut.homes[pairs[both, 1]]).all()


def test_a_walk_is_cut_across_as_few_frames_as_see_across() -> None:
    pairs = chain(100, 5)
    cut = partition(100, pairs, 50)
    check(cut, pairs, 50)
    assert np.count_nonzero(cut.on_cut) == 5
    assert cut.num_parts == 2


@pytest.mark.parametrize("placed", [True, False])
def test_a_grid_is_cut_along_its_lines(placed: bool) -> None:
    pairs, positions = grid(20)
    cut = partition(400, pairs, 100, positions if placed else None)
    check(cut, pairs, 100)
    assert np.count_nonzero(cut.on_cut) <= 80  # four lines
    again = partition(400, pairs, 100, positions if placed else None)
    np.testing.assert_array_equal(cut.homes, again.homes)


def test_maps_without_a_tie_are_parted_without_a_cut() -> None:
    pairs = np.concatenate([chain(30, 3), 30 + chain(30, 3)])
    cut = partition(60, pairs, 30)
    check(cut, pairs, 30)
    assert not cut.on_cut.any()


def test_frames_that_all_see_each_other_end_on_the_cut() -> None:
    pairs = np.column_stack(np.triu_indices(12, 1))
    check(partition(12, pairs, 4), pairs, 4)


def test_every_item_is_owned_by_the_part_that_sees_it() -> None:
    pairs = chain(100, 5)
    cut = partition(100, pairs, 50)
    frames = np.arange(95)[:, None] + np.arange(6)
    owners = cut.owners(frames.ravel(), np.repeat(np.arange(95), 6), 95)
    for rows, owner in zip(frames, owners, strict=True):
        own = rows[~cut.on_cut[rows]]
        assert (cut.homes[own] == owner).all()
    assert cut.owners(np.empty(0, int), np.empty(0, int), 1) == [0]
