"""Images of a frame for all datasets of an export: each is read, cut and encoded once. Unchanged
ones are copies that share blocks where file systems can (reflinks), or on request hard links."""

import fcntl
import os
import shutil
import threading
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path, PurePosixPath
from types import NoneType
from typing import Any

import numpy as np

from gsba.camera.pictures import Picture, padded_panorama
from gsba.camera.straighten import PAD
from gsba.disk import atomic_write, encoded_image, write_bytes
from gsba.export.dataset import MASK_FILES, MaskStyle
from gsba.frames.files import goes_out_as_it_is
from gsba.frames.masks import load_mask
from gsba.frames.pixels import Buffers, load_padded, pictures_of
from gsba.log import GsbaError
from gsba.store.shards import even_blocks
from gsba.types import FrameSet, cameras_of

_EXPORTED_SUFFIX = {".insp": ".jpg", ".webp": ".jpg", ".tif": ".png", ".tiff": ".png"}


@dataclass(frozen=True, slots=True)
class Files:
    """Files of a dataset's images and masks.

    Patterns are filled with the `name` of a frame, the `suffix` of its exported images, and the
    `view`.
    """

    folder: Path  # folder of the dataset, absolute
    views: Sequence[str]  # views of a frame; one "" if the pattern has no view
    image: str  # pattern of the images' paths in the folder
    mask: str  # pattern of the masks' paths (PNG, by default 0 = ignore, 255 = use); "" = there
    # are none
    style: MaskStyle = MASK_FILES
    names: Mapping[str, str] = field(
        default_factory=dict
    )  # by frame name, where images have others

    @property
    def paints(self) -> bool:
        """True if images are painted where masks hide them."""
        return bool(self.mask) and self.style.paints

    def images(self, frames: FrameSet, f: int) -> list[str]:
        """Paths of a frame's images in the folder, by view."""
        return self._filled(self.image, frames, f)

    def masks(self, frames: FrameSet, f: int) -> list[str]:
        """Paths of a frame's masks in the folder, by view; [] = there are none."""
        if self.mask and self.style.path:
            paths = map(PurePosixPath, self.images(frames, f))
            return [self.style.path.format(folder=path.parent, stem=path.stem) for path in paths]
        return self._filled(self.mask, frames, f) if self.mask else []

    def make_folders(self, frames: FrameSet) -> None:
        """Make the folders of all images and masks."""
        every = range(len(frames))
        files = (path for f in every for path in (*self.images(frames, f), *self.masks(frames, f)))
        for parent in {Path(path).parent for path in files}:
            (self.folder / parent).mkdir(parents=True, exist_ok=True)

    def known(self, frames: FrameSet, f: int) -> dict[str, str]:
        """Name of a frame's images, and their suffix: that of the input, or one that holds the
        image and that all programs read."""
        suffix, name = frames.paths[f][0].suffix, frames.names[f]
        suffix = _EXPORTED_SUFFIX.get(suffix.lower(), suffix)
        if self.paints and self.style.paint == "alpha":
            suffix = ".png"
        return {"name": self.names.get(name, name), "suffix": suffix}

    def _filled(self, pattern: str, frames: FrameSet, f: int) -> list[str]:
        known = self.known(frames, f)
        return [pattern.format(view=view, **known) for view in self.views]


@dataclass(frozen=True, slots=True)
class FrameWriter:
    """Writes a frame's images and masks of a dataset."""

    files: Files

    def __call__(self, shown: "SharedPixels") -> None:
        """Write images and masks into existing folders."""
        raise NotImplementedError

    def taken(self, rows: np.ndarray) -> "FrameWriter":
        """Writer of frames `rows` (F',), renumbered; it can be pickled."""
        return self

    def images(self, shown: "SharedPixels") -> list[Path]:
        """Files of the frame's images."""
        return [self.files.folder / name for name in self.files.images(shown.frames, shown.f)]

    def masks(self, shown: "SharedPixels") -> list[Path]:
        """Files of the frame's masks; [] = there are none."""
        return [self.files.folder / name for name in self.files.masks(shown.frames, shown.f)]

    def write(
        self,
        shown: "SharedPixels",
        key: Hashable,
        images: Callable[[], Iterable[np.ndarray]],
        masks: Callable[[], Iterable[np.ndarray]],
        masks_differ: bool = False,
        originals: Sequence[Path] = (),
        link: bool = False,
    ) -> None:
        """Write a frame's images, painted where masks hide them if wanted, and its masks.

        Args:
            key: of these images, one for all datasets that have the same.
            images: makes the images (h, w, 3) uint8 RGB, by view.
            masks: makes the masks (h, w) bool, True = use, by view.
            masks_differ: masks depend on the frame beyond its mask file.
            originals: files with the same pixels, by view, to be copied if readers understand
                them; () = there are none.
        """
        paths, hidden, style = self.images(shown), self.masks(shown), self.files.style
        if self.files.paints:
            painted = style.paint, masks_differ
            shown.write((key, painted), paths, lambda: map(style.painted, images(), masks()))
        elif originals and all(map(goes_out_as_it_is, originals, paths)):
            for source, path in zip(originals, paths, strict=True):
                if not source.is_file():
                    raise GsbaError(
                        f"{source} is missing; it existed when the run began: restore it"
                    )
                atomic_write(path, partial(_copy, source, link=link), parents=False)
        else:
            shown.write(key, paths, images)
        if hidden:
            shown.write_masks(key, hidden, masks, style, masks_differ)

    def wrote(self, shown: "SharedPixels") -> bool:
        """True if an interrupted export has written all files of this frame."""
        return all(path.exists() for path in (*self.images(shown), *self.masks(shown)))


class Pictures:
    """Job that writes the images of each frame for several datasets, each with a writer for each
    camera's frames (C,).

    A thread holds one panorama, and reuses its memory for the next frame.
    """

    title = "writing images"
    returns: Any = NoneType

    def __init__(self, frames: FrameSet, datasets: Sequence[Sequence[FrameWriter]]) -> None:
        self.frames, self._datasets = frames, datasets
        self._cameras = frames.cameras.tolist()
        self.buffers = Buffers()
        self._uses = Counter(frames.mask_paths)
        self._masks: dict[Hashable, list[bytes]] = {}
        self._lock = threading.Lock()

    def __reduce__(self) -> tuple[object, ...]:  # buffers and masks are not pickled
        return Pictures, (self.frames, self._datasets)

    def __len__(self) -> int:
        return len(self.frames)

    def __call__(self, item: int) -> None:
        shown = SharedPixels(self, item)
        for writers in self._datasets:
            writer = writers[self._cameras[item]]
            if not writer.wrote(shown):
                writer(shown)

    def blocks(self) -> Sequence[tuple[int, int]]:
        return even_blocks(len(self.frames))

    def part(self, start: int, stop: int) -> "Pictures":
        rows = np.arange(start, stop)
        used, _ = cameras_of(self.frames.camera_of_frame, rows)
        datasets = [[writers[c].taken(rows) for c in used] for writers in self._datasets]
        return Pictures(self.frames.taken(rows, absolute=True), datasets)

    def masks(self, key: Hashable, make: Callable[[], list[bytes]]) -> list[bytes]:
        """Encoded masks under a key, made by the first frame that needs them."""
        with self._lock:  # so that only one thread makes them
            if key not in self._masks:
                self._masks[key] = make()
            return self._masks[key]


class SharedPixels:
    """Pixels and encoded images of one frame, shared by all datasets of an export."""

    def __init__(self, pictures: Pictures, f: int) -> None:
        self.f, self.frames = f, pictures.frames
        self.kind = pictures.frames.format_of(f)
        self._pictures = pictures
        self._padded: np.ndarray | None = None
        self._files: dict[Hashable, list[bytes]] = {}

    @property
    def padded(self) -> np.ndarray:
        """The panorama (h + 2 PAD, 2 h + 2 PAD, 3) uint8 RGB, until the thread's next frame."""
        if self._padded is None:
            self._padded = load_padded(self.frames, self.f, self._pictures.buffers)
        return self._padded

    @property
    def erp(self) -> np.ndarray:
        """The panorama (h, 2 h, 3) uint8 RGB, until the thread's next frame."""
        return self.padded[PAD:-PAD, PAD:-PAD]

    def pictures(self, focal: float = np.inf, joined: bool = False) -> list[Picture]:
        """See `gsba.frames.pixels.pictures_of`, until the thread's next frame; `joined`: those of
        raw lenses as one panorama."""
        if self.kind.tracks is None and (joined or self.kind.fisheyes is None):
            return [padded_panorama(self.padded, focal)]
        return pictures_of(self.frames, self.f, focal)

    @property
    def mask(self) -> np.ndarray:
        """Mask of the panorama (h, 2 h) bool, True = use."""
        found = load_mask(self.frames, self.f)
        size = self.kind.height, self.kind.width
        return np.ones(size, bool) if found is None else found

    def room(self, name: str, shape: tuple[int, ...]) -> np.ndarray:
        """Buffer for images of one kind, until the thread's next frame."""
        return self._pictures.buffers.array(name, shape)

    def write(
        self, key: Hashable, paths: Sequence[Path], make: Callable[[], Iterable[np.ndarray]]
    ) -> None:
        """Write images, one to each path; `make` is called once for all datasets with this key."""
        key = key, tuple(path.suffix for path in paths)
        if key in self._files:
            _write(paths, self._files[key])
            return
        self._files[key] = []
        for path, image in zip(paths, make(), strict=True):
            content = encoded_image(image, path)
            self._files[key].append(content)
            write_bytes(path, content, parents=False)

    def write_masks(
        self,
        key: Hashable,
        paths: Sequence[Path],
        make: Callable[[], Iterable[np.ndarray]],
        style: MaskStyle,
        differ: bool,
    ) -> None:
        """Write masks (h, w) bool that depend only on the key, the camera's format and the frame's
        mask file or, if they differ, on the frame."""

        def drawn() -> Iterable[np.ndarray]:
            return map(style.drawn, make())

        def encode() -> list[bytes]:
            return list(map(encoded_image, drawn(), paths))

        key = "mask", key, style.hidden, self.kind, self.frames.mask_paths[self.f]
        if (self._pictures._uses[self._pictures.frames.mask_paths[self.f]] > 1) and not differ:
            _write(paths, self._pictures.masks(key, encode))
        else:
            self.write(key, paths, drawn)


def _write(paths: Sequence[Path], contents: Sequence[bytes]) -> None:
    for path, content in zip(paths, contents, strict=True):
        write_bytes(path, content, parents=False)


def _copy(source: Path, path: Path, link: bool) -> None:
    """Copy `source` to `path`, sharing its blocks on disk if the file system can."""
    if link:
        with suppress(OSError):  # another file system
            os.link(source.resolve(), path)
            return
    with suppress(OSError), source.open("rb") as original, path.open("wb") as clone:
        # FICLONE of Linux: both files share blocks until one is written.
        fcntl.ioctl(clone, 0x40049409, original.fileno())
        return
    shutil.copyfile(source, path)
