"""What a panorama looks like, whatever its heading.

Looks are compared as vectors of locally aggregated descriptors (VLAD: Jegou et al., CVPR 2010;
normalised word by word as in Arandjelovic and Zisserman, CVPR 2013) over whole panoramas.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from scipy.sparse import csr_matrix

from gsba.matching.guided_search import SearchableFrames
from gsba.store.shards import Workers, blocks_of_frames

_WORDS = 64  # of the vocabulary
_SAMPLES = 20_000  # descriptors it is made from
_ROUNDING = 1e-5  # of descriptors, float32 and of length one: a shorter sum has no direction


def global_descriptors(
    frames: SearchableFrames, num_frames: int, seed: int, workers: Workers
) -> np.ndarray:
    """What each panorama looks like, whatever its heading: (F, D) float32 of length one."""
    share = max(_SAMPLES // max(num_frames, 1), 8)
    draw = partial(_drawn, share=share, seed=seed)
    everyone = np.arange(num_frames)
    sample = np.concatenate(list(workers.map_shards(_LookJob("sampling", frames, everyone, draw))))
    words = _words(sample, np.random.default_rng(seed))
    job = _LookJob("looks", frames, everyone, partial(_seen, words=words))
    looks = np.empty((num_frames, words.size), np.float32)
    for row, look in zip(looks, workers.map_shards(job), strict=True):
        row[:] = look
    return looks


@dataclass(frozen=True, slots=True)
class _LookJob:
    """The job of looking at the descriptors of each frame."""

    title: str
    frames: SearchableFrames
    chosen: np.ndarray  # (F,) frames
    look: Callable[[np.ndarray, int], np.ndarray]  # at descriptors (K, D) of a frame
    returns: Any = np.ndarray

    def __len__(self) -> int:
        return len(self.chosen)

    def __call__(self, item: int) -> np.ndarray:
        frame = int(self.chosen[item])
        return self.look(self.frames[frame].descriptors, frame)

    def blocks(self) -> Sequence[tuple[int, int]]:
        return blocks_of_frames(self.chosen)

    def part(self, start: int, stop: int) -> "_LookJob":
        chosen = self.chosen[start:stop]
        return replace(self, chosen=chosen, frames=self.frames.taken(chosen.tolist()))


def _drawn(descriptors: np.ndarray, frame: int, share: int, seed: int) -> np.ndarray:
    """Some descriptors of a frame, the same whoever draws them."""
    return np.random.default_rng([seed, frame]).permutation(descriptors)[:share].copy()


def _seen(descriptors: np.ndarray, _frame: int, words: np.ndarray) -> np.ndarray:
    """What a frame looks like, whichever it is."""
    return _aggregate(descriptors, words)


def _words(sample: np.ndarray, rng: np.random.Generator, rounds: int = 12) -> np.ndarray:
    """Centres (W, D) of a k-means clustering."""
    words = sample[rng.permutation(len(sample))[:_WORDS]].copy()
    for _ in range(rounds):
        nearest = _nearest(sample, words)
        counts = np.bincount(nearest, minlength=len(words))
        sums = _sums(sample, nearest, len(words))
        words = np.where(counts[:, None] > 0, sums / np.maximum(counts, 1)[:, None], words)
    return words


def _nearest(descriptors: np.ndarray, words: np.ndarray) -> np.ndarray:
    return np.argmax(descriptors @ words.T - 0.5 * np.sum(words**2, axis=1), axis=1)


def _sums(rows: np.ndarray, groups: np.ndarray, num: int) -> np.ndarray:
    """Sums (num, D) of the rows (K, D) of each group."""
    ones, starts = np.ones(len(rows), rows.dtype), np.arange(len(rows) + 1)
    return csr_matrix((ones, groups, starts), shape=(len(rows), num)).T @ rows


def _aggregate(descriptors: np.ndarray, words: np.ndarray) -> np.ndarray:
    """Sums of the differences from the nearest words, each word's of length one."""
    nearest = _nearest(descriptors, words)
    sums = _sums(descriptors - words[nearest], nearest, len(words))
    lengths = np.linalg.norm(sums, axis=1, keepdims=True)
    sums = np.divide(sums, lengths, out=np.zeros_like(sums), where=lengths > _ROUNDING)
    return sums.ravel() / max(float(np.linalg.norm(sums)), 1e-12)
