"""Memory that threads use again for every frame."""

import math
import threading

import numpy as np


class Buffers(threading.local):
    """Arrays of a thread, by name: fetching fresh pages costs as much as filling them."""

    def __init__(self) -> None:
        self._kept: dict[str, np.ndarray] = {}

    def array(self, name: str, shape: tuple[int, ...]) -> np.ndarray:
        """Array uint8 with whatever was in it; the next of the same name in the same thread takes
        its place."""
        size = math.prod(shape)
        if name not in self._kept or self._kept[name].size < size:
            self._kept.pop(name, None)
            self._kept[name] = np.empty(size, np.uint8)
        return self._kept[name][:size].reshape(shape)
