"""Place recognition by global descriptors of panoramas, invariant to heading: VLAD (Jegou et al.,
CVPR 2010), normalised word by word (Arandjelovic and Zisserman, CVPR 2013)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import csr_matrix

from gsba.disk import concatenated
from gsba.matching.guided_search import SearchableFrames
from gsba.store.shards import Workers, blocks_of_frames


def global_descriptors(
    frames: SearchableFrames,
    num_frames: int,
    seed: int,
    workers: Workers,
    scratch: Path | None = None,
) -> np.ndarray:
    """Global descriptors (F, D) float32 of panoramas, of unit length, invariant to heading; on the
    disk in the folder `scratch`, None = in memory."""
    words, everyone = visual_words(frames, num_frames, seed, workers), np.arange(num_frames)
    job = _DescriptorJob("looks", frames, everyone, partial(_descriptor_of, words=words))
    looks = ((look[None].astype(np.float32),) for look in workers.map_shards(job))
    return concatenated(looks, scratch)[0]


def visual_words(
    frames: SearchableFrames, num_frames: int, seed: int, workers: Workers
) -> np.ndarray:
    """Vocabulary (W, D) float32 of the descriptors of all frames, for `aggregate`."""
    share = max(20_000 // max(num_frames, 1), 8)  # descriptors of all frames train it
    draw = partial(_sampled_descriptors, share=share, seed=seed)
    job = _DescriptorJob("sampling", frames, np.arange(num_frames), draw)
    return _centres(np.concatenate(list(workers.map_shards(job))), seed)


def _centres(sample: np.ndarray, seed: int) -> np.ndarray:
    """Centres (W, D) of the k-means clusters of descriptors (K, D)."""
    rng = np.random.default_rng(seed)
    words = sample[rng.permutation(len(sample))[:64]].copy()
    for _ in range(12):
        nearest = _nearest(sample, words)
        counts = np.bincount(nearest, minlength=len(words))
        sums = _sums_by_group(sample, nearest, len(words))
        words = np.where(counts[:, None] > 0, sums / np.maximum(counts, 1)[:, None], words)
    return words


@dataclass(frozen=True, slots=True)
class _DescriptorJob:
    """The job of processing the descriptors of each frame."""

    title: str
    frames: SearchableFrames
    chosen: np.ndarray  # (F,) frames
    look: Callable[[np.ndarray, int], np.ndarray]  # of descriptors (K, D) of a frame
    returns: Any = np.ndarray

    def __len__(self) -> int:
        return len(self.chosen)

    def __call__(self, item: int) -> np.ndarray:
        frame = int(self.chosen[item])
        return self.look(self.frames[frame].descriptors, frame)

    def blocks(self) -> Sequence[tuple[int, int]]:
        return blocks_of_frames(self.chosen)

    def part(self, start: int, stop: int) -> "_DescriptorJob":
        chosen = self.chosen[start:stop]
        return replace(self, chosen=chosen, frames=self.frames.taken(chosen.tolist()))


def _sampled_descriptors(descriptors: np.ndarray, frame: int, share: int, seed: int) -> np.ndarray:
    """A sample of a frame's descriptors that does not depend on the worker."""
    return np.random.default_rng([seed, frame]).permutation(descriptors)[:share].copy()


def _descriptor_of(descriptors: np.ndarray, _frame: int, words: np.ndarray) -> np.ndarray:
    return aggregate(descriptors, words)


def _nearest(descriptors: np.ndarray, words: np.ndarray) -> np.ndarray:
    return np.argmax(descriptors @ words.T - 0.5 * np.sum(words**2, axis=1), axis=1)


def _sums_by_group(rows: np.ndarray, groups: np.ndarray, num: int) -> np.ndarray:
    """Sums (num, D) of the rows (K, D) of each group."""
    ones, starts = np.ones(len(rows), rows.dtype), np.arange(len(rows) + 1)
    return csr_matrix((ones, groups, starts), shape=(len(rows), num)).T @ rows


def aggregate(descriptors: np.ndarray, words: np.ndarray) -> np.ndarray:
    """Global descriptor (W D,) of descriptors (K, D): sums of the differences from the nearest
    words (W, D), normalised word by word."""
    nearest = _nearest(descriptors, words)
    sums = _sums_by_group(descriptors - words[nearest], nearest, len(words))
    lengths = np.linalg.norm(sums, axis=1, keepdims=True)
    # descriptors are rounded, float32 of unit length: a shorter sum has no direction
    sums = np.divide(sums, lengths, out=np.zeros_like(sums), where=lengths > 1e-5)
    return sums.ravel() / max(float(np.linalg.norm(sums)), 1e-12)
