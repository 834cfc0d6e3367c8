"""Patches cut from frames, and aligned to frames: jobs with one item a frame."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from factors.patches import PatchSet, Sightings
from factors.sphere_image import SphereImage
from gsba.frames.panorama import Greys
from gsba.store.shards import Workers, blocks_of_frames

MAX_SHIFT_PX = 3.0  # from the predicted pixel, panorama pixels
_AFFINE_SIGMA = 0.15  # prior of the warp: a surface facing the ray
_BLUR_SIGMA = 0.3  # template pixels squared, prior of half a difference of blurs
_MAX_STEPS = 12  # largest number of alignment steps


def cut(
    name: str,
    greys: Greys,
    hosts: np.ndarray,
    origins: np.ndarray,
    spreads: np.ndarray,
    size: int,
    workers: Workers,
) -> PatchSet:
    """Templates of `size` pixels across, odd, cut from their host frames (J,): plane patches,
    origins (J, 3) and spreads (J, 3, 2), rig frame of the host."""
    patches = _empty_patches(len(hosts), size)
    rows = _by_frame(hosts, greys.num_frames)
    job = _CutJob(name, greys, rows, origins, spreads, size)
    for chosen, found in zip(rows.each(), workers.map_shards(job), strict=True):
        for array, part in zip(patches.columns().values(), found, strict=True):
            array[chosen] = part
    return patches


def align(
    name: str,
    greys: Greys,
    seeing: np.ndarray,
    patches: PatchSet,
    sightings: Sightings,
    workers: Workers,
) -> None:
    """Align templates to the frames (O,) that should show them; results are written to the
    sightings."""
    rows = _by_frame(seeing, greys.num_frames)
    job = _AlignJob(name, greys, rows, patches, sightings)
    for chosen, found in zip(rows.each(), workers.map_shards(job), strict=True):
        arrays = sightings.warps, sightings.scores, sightings.variances, sightings.states
        for array, part in zip(arrays, found, strict=True):
            array[chosen] = part


def align_to(
    image: SphereImage, mask: np.ndarray | None, patches: PatchSet, sightings: Sightings
) -> None:
    """Align templates to one picture, where its mask (H, 2H) is True; results are written to the
    sightings."""
    reach, every = 1.5 * MAX_SHIFT_PX, np.arange(len(sightings.templates))
    patches.align(image, mask, every, sightings, reach, _MAX_STEPS, 0.02)


def _empty_patches(num: int, size: int) -> PatchSet:
    """Empty storage for templates."""
    # noise of 3 grey values, a window of .6 half patches
    return PatchSet(num, size, 0.6, _AFFINE_SIGMA, _BLUR_SIGMA, 3.0)


@dataclass(frozen=True, slots=True)
class _Rows:
    """Rows of a table, grouped by frame."""

    frames: np.ndarray  # (N,) ascending, those with rows
    order: np.ndarray  # (R,) rows, frame by frame
    bounds: np.ndarray  # (N + 1,)

    def each(self) -> Sequence[np.ndarray]:
        return [self.order[a:b] for a, b in pairwise(self.bounds.tolist())]

    def of(self, item: int) -> np.ndarray:
        return self.order[self.bounds[item] : self.bounds[item + 1]]

    def taken(self, start: int, stop: int) -> tuple[np.ndarray, "_Rows"]:
        """Rows of some items, and these renumbered by their place among them."""
        bounds = self.bounds[start : stop + 1]
        chosen = self.order[bounds[0] : bounds[-1]]
        frames = np.arange(stop - start)
        return chosen, _Rows(frames, np.arange(len(chosen)), bounds - bounds[0])


def _by_frame(frame_of: np.ndarray, num_frames: int) -> _Rows:
    order = np.argsort(frame_of, kind="stable")
    bounds = np.searchsorted(frame_of[order], np.arange(num_frames + 1))
    frames = np.flatnonzero(np.diff(bounds))
    return _Rows(frames, order, np.append(bounds[frames], len(order)))


@dataclass(frozen=True, slots=True)
class _FrameJob:
    """A job with one item for each frame that has rows."""

    title: str
    greys: Greys
    rows: _Rows

    @property
    def returns(self) -> Any:
        return tuple[np.ndarray, ...]

    def __len__(self) -> int:
        return len(self.rows.frames)

    def blocks(self) -> Sequence[tuple[int, int]]:
        return blocks_of_frames(self.rows.frames)

    def image(self, item: int) -> tuple[SphereImage, np.ndarray | None]:
        """Image of a frame, and its mask."""
        grey, mask = self.greys[int(self.rows.frames[item])]
        return SphereImage.of(grey, smooth=True), mask


@dataclass(frozen=True, slots=True)
class _CutJob(_FrameJob):
    """The job of cutting templates."""

    origins: np.ndarray  # (J, 3)
    spreads: np.ndarray  # (J, 3, 2)
    size: int  # pixels across a template

    def __call__(self, item: int) -> tuple[np.ndarray, ...]:
        rows = self.rows.of(item)
        found = _empty_patches(len(rows), self.size)
        every, least = np.arange(len(rows)), 2.0  # grey values, standard deviation in a patch
        found.cut(*self.image(item), every, self.origins[rows], self.spreads[rows], least)
        return tuple(found.columns().values())

    def part(self, start: int, stop: int) -> "_CutJob":
        chosen, rows = self.rows.taken(start, stop)
        return replace(
            self,
            greys=self.greys.taken(self.rows.frames[start:stop]),
            rows=rows,
            origins=self.origins[chosen],
            spreads=self.spreads[chosen],
        )


@dataclass(frozen=True, slots=True)
class _AlignJob(_FrameJob):
    """The job of aligning templates."""

    patches: PatchSet
    sightings: Sightings

    def __call__(self, item: int) -> tuple[np.ndarray, ...]:
        rows = self.rows.of(item)
        own = Sightings(*(column[rows] for column in self.sightings))
        align_to(*self.image(item), self.patches, own)
        return own.warps, own.scores, own.variances, own.states

    def part(self, start: int, stop: int) -> "_AlignJob":
        chosen, rows = self.rows.taken(start, stop)
        own = Sightings(*(column[chosen] for column in self.sightings))
        used, templates = np.unique(own.templates, return_inverse=True)
        return replace(
            self,
            greys=self.greys.taken(self.rows.frames[start:stop]),
            rows=rows,
            patches=self.patches.taken(used),
            sightings=own._replace(templates=templates),
        )
