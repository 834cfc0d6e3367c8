"""Pictures that the datasets of one export show of a frame: read once, cut once, encoded once."""

import threading
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Sequence
from pathlib import Path

import numpy as np

from gsba.camera.straighten import PAD
from gsba.disk import encoded_image, write_bytes
from gsba.frames.buffers import Buffers
from gsba.frames.masks import load_mask
from gsba.frames.pixels import load_padded
from gsba.types import FrameSet


class Pictures:
    """What the frames of one export have in common.

    A thread holds one panorama, in memory that it uses for the next frame again.
    """

    def __init__(self, frames: FrameSet) -> None:
        self.frames = frames
        self.buffers = Buffers()
        self._uses = Counter(frames.mask_paths)
        self._masks: dict[Hashable, list[bytes]] = {}
        self._lock = threading.Lock()

    def same_mask(self, f: int) -> bool:
        """Whether another frame has the mask of frame f."""
        return self._uses[self.frames.mask_paths[f]] > 1

    def masks(self, key: Hashable, make: Callable[[], list[bytes]]) -> list[bytes]:
        """Files as the first frame that asks by this key has them made."""
        with self._lock:  # so that no other thread makes them too
            if key not in self._masks:
                self._masks[key] = make()
            return self._masks[key]


class Shown:
    """One frame of an export, for the datasets that show it."""

    def __init__(self, pictures: Pictures, f: int) -> None:
        self.f = f
        self._pictures, self._frames = pictures, pictures.frames
        self._padded: np.ndarray | None = None
        self._files: dict[Hashable, list[bytes]] = {}

    @property
    def padded(self) -> np.ndarray:
        """The panorama (h + 2 PAD, 2 h + 2 PAD, 3) uint8 RGB, until the thread's next frame."""
        if self._padded is None:
            self._padded = load_padded(self._frames, self.f, self._pictures.buffers)
        return self._padded

    @property
    def erp(self) -> np.ndarray:
        """The panorama (h, 2 h, 3) uint8 RGB, until the thread's next frame."""
        return self.padded[PAD:-PAD, PAD:-PAD]

    @property
    def mask(self) -> np.ndarray:
        """Where the panorama may be used, (h, 2 h) bool."""
        found = load_mask(self._frames, self.f)
        size = self._frames.height, self._frames.width
        return np.ones(size, bool) if found is None else found

    def room(self, name: str, shape: tuple[int, ...]) -> np.ndarray:
        """Memory for pictures of one kind, until the thread's next frame."""
        return self._pictures.buffers.array(name, shape)

    def write(
        self, key: Hashable, paths: Sequence[Path], make: Callable[[], Iterable[np.ndarray]]
    ) -> None:
        """Write pictures, one to each path: as made for the first dataset that asks by this key."""
        key = key, tuple(path.suffix for path in paths)
        if key in self._files:
            _write(paths, self._files[key])
            return
        self._files[key] = []
        for path, image in zip(paths, make(), strict=True):
            content = encoded_image(image, path)
            self._files[key].append(content)
            write_bytes(path, content)

    def write_masks(
        self, key: Hashable, paths: Sequence[Path], make: Callable[[], Iterable[np.ndarray]]
    ) -> None:
        """As `write`, of masks (h, w) bool that rest on the frame's own and on the key alone."""

        def encode() -> list[bytes]:
            pairs = zip(make(), paths, strict=True)
            return [encoded_image(part.astype(np.uint8) * 255, path) for part, path in pairs]

        key = "mask", key, self._frames.mask_paths[self.f]
        if self._pictures.same_mask(self.f):
            _write(paths, self._pictures.masks(key, encode))
        else:
            self.write(key, paths, lambda: (part.astype(np.uint8) * 255 for part in make()))


def _write(paths: Sequence[Path], contents: Sequence[bytes]) -> None:
    for path, content in zip(paths, contents, strict=True):
        write_bytes(path, content)
