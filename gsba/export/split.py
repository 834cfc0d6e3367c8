"""Images of a dataset in an order by which its reader holds out whole panoramas.

Trainers that read COLMAP models hold out every eighth image: INRIA's (`--eval`), gsplat, 3DGRUT and
Brush (`--eval-split-every 8`) in the order of names, nerfstudio's COLMAP parser in that of numbers,
LichtFeld (`--eval`) as they come in the file. Images are numbered so that all orders agree and
every eighth one is a face of a held-out panorama; its other faces are left out, as they share its
centre. Readers of lists (`train_list.txt`, ..., `sparse/0/test.txt`) get the same split.
"""

import logging
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count, islice
from pathlib import Path

import numpy as np

from gsba.export.pictures import Files
from gsba.frames.held_out import HOLD_OUT_EVERY, held_out_rows
from gsba.log import GsbaError
from gsba.types import FrameSet, PoseStatus, Reconstruction

logger = logging.getLogger(__name__)

LEFT_OUT = "left_out"  # folder of faces of held-out panoramas that no reader may see
_MIN_TRAINING = 2  # panoramas
MIN_DIGITS = 5  # of an image's place in its name
TRAIN_LIST = "train_list.txt"  # names of images for training, if there is a split
_TEST_LISTS = ("val_list.txt", "test_list.txt", "sparse/0/test.txt")  # and of those held out


@dataclass(frozen=True, slots=True)
class DatasetSplit:
    """Held-out panoramas of a dataset, and the order of its images."""

    held_out: np.ndarray  # (F,) bool
    numbers: tuple[tuple[int, ...], ...]  # (F, views) place of each image in the order; -1 = left
    # out of the dataset

    def files(self, plain: Files, frames: FrameSet) -> Files:
        """Files of the same images, in folders without others, under names in this order."""
        places = dict(zip(frames.names, self.numbers, strict=True))
        given = plain.folder, plain.views, plain.image, plain.mask, plain.style, plain.names
        digits = max(MIN_DIGITS, len(str(max(map(max, self.numbers)))))
        return _OrderedFiles(*given, places=places, digits=digits)

    def write_lists(self, folder: Path, names: Sequence[Sequence[str]]) -> None:
        """Write the lists that some readers hold images out by.

        Args:
            folder: of the dataset, with the model's.
            names: (F, views) of the images, in the model.
        """
        every = [
            (number, name, held)
            for held, numbers, own in zip(self.held_out, self.numbers, names, strict=True)
            for number, name in zip(numbers, own, strict=True)
            if number >= 0
        ]
        training = "".join(f"{name}\n" for _, name, held in sorted(every) if not held)
        test = "".join(f"{name}\n" for _, name, held in sorted(every) if held)
        (folder / TRAIN_LIST).write_text(training)
        for path in _TEST_LISTS:
            (folder / path).write_text(test)


def split_of(
    reconstruction: Reconstruction, num_views: Sequence[int], num_photos: int = 0
) -> DatasetSplit | None:
    """Split of a dataset by whole panoramas; None = too few are left to train on.

    Args:
        reconstruction: poses of the frames; unrefined ones are not held out.
        num_views: (F,) images of each frame.
        num_photos: images that come later and take free numbers, see `add_images`.
    """
    usable = reconstruction.pose_statuses == PoseStatus.REFINED
    held_out = _held_out(usable, np.array(num_views))
    if held_out is None:
        logger.warning(
            "too few panoramas to hold one of %d out: all images are for training", HOLD_OUT_EVERY
        )
        return None
    images = [(view, f) for f, num in enumerate(num_views) for view in range(num)]
    training = sorted((f, view) for view, f in images if not held_out[f])
    # The first views of all held-out frames: what is left out is below or above the camera.
    num_test = _num_test(len(training) + num_photos)
    test = sorted(image for image in images if held_out[image[1]])[:num_test]
    numbers = [[-1] * num for num in num_views]
    for place, (f, view) in enumerate(sorted((f, view) for view, f in test)):
        numbers[f][view] = HOLD_OUT_EVERY * place
    for place, (f, view) in enumerate(training):
        numbers[f][view] = place + place // (HOLD_OUT_EVERY - 1) + 1
    return DatasetSplit(held_out, tuple(map(tuple, numbers)))


def require_held_out(reconstruction: Reconstruction) -> None:
    """Refuse a split that leaves too few panoramas to train on. Raises GsbaError: it does."""
    if not held_out_frames(reconstruction).any():
        num = np.count_nonzero(reconstruction.pose_statuses == PoseStatus.REFINED)
        raise GsbaError(
            f"--split: {num} refined panoramas are too few to hold one out and train on "
            f"{_MIN_TRAINING}: use --no-split"
        )


def held_out_frames(reconstruction: Reconstruction) -> np.ndarray:
    """Frames (F,) bool to hold out, where all faces of each can be."""
    usable = reconstruction.pose_statuses == PoseStatus.REFINED
    enough = np.count_nonzero(usable) > _MIN_TRAINING
    return _spread(usable) if enough else np.zeros(len(usable), bool)


def add_images(folder: Path, taken: Collection[int], names: Sequence[str]) -> dict[str, int]:
    """Number images that belong to no panorama, and add them to the lists of a split.

    They are for training, but for those whose number readers hold out.

    Args:
        folder: of the dataset, whose lists `Split.write_lists` wrote.
        taken: numbers of the other images.
        names: of the images, in the model.

    Returns:
        Number of each image by its name, which begins with it.
    """
    known = set(taken)
    free = islice((n for n in count() if n not in known), len(names))
    numbers = {f"{n:0{MIN_DIGITS}d}_{name}": n for n, name in zip(free, names, strict=True)}
    for path in (TRAIN_LIST, *_TEST_LISTS):
        held_out = path != TRAIN_LIST
        with (folder / path).open("a", encoding="utf-8") as file:
            own = [name for name, n in numbers.items() if (n % HOLD_OUT_EVERY == 0) == held_out]
            file.writelines(f"{name}\n" for name in own)
    return numbers


def _held_out(usable: np.ndarray, num_views: np.ndarray) -> np.ndarray | None:
    """Frames (F,) bool to hold out whose faces are enough for one image in eight."""
    for num in range(1, np.count_nonzero(usable)):
        chosen = _spread(usable, num)
        if np.count_nonzero(~chosen) < _MIN_TRAINING:
            return None
        if num_views[chosen].sum() >= _num_test(int(num_views[~chosen].sum())):
            return chosen
    return None


def _spread(usable: np.ndarray, at_least: int = 0) -> np.ndarray:
    """Frames (F,) bool to hold out, spread over the usable ones."""
    rows, chosen = np.flatnonzero(usable), np.zeros(len(usable), bool)
    chosen[rows[held_out_rows(len(rows), at_least=at_least)]] = True
    return chosen


def _num_test(num_training: int) -> int:
    """Number of images that are held out beside so many."""
    return -(-num_training // (HOLD_OUT_EVERY - 1))


@dataclass(frozen=True, slots=True)
class _OrderedFiles(Files):
    """Files whose names begin with their place in an order."""

    places: Mapping[str, Sequence[int]] = field(default_factory=dict)  # by frame name and view, see
    # `Split.numbers`
    digits: int = MIN_DIGITS  # of a place

    def _filled(self, pattern: str, frames: FrameSet, f: int) -> list[str]:
        folder, _, name = pattern.partition("/")
        known = self.known(frames, f)
        return [
            f"{folder}/{number:0{self.digits}d}_{name.format(view=view, **known)}"
            if number >= 0
            else f"{LEFT_OUT}/{folder}/{name.format(view=view, **known)}"
            for view, number in zip(self.views, self.places[frames.names[f]], strict=False)
        ]  # frames of other cameras have other numbers of views
