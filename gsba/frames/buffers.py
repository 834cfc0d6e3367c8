"""Memory that threads reuse for every frame."""

import math
import threading

import numpy as np


class Buffers(threading.local):
    """A thread's arrays by name: allocating fresh pages costs as much as filling them."""

    def __init__(self) -> None:
        self._kept: dict[str, np.ndarray] = {}

    def array(self, name: str, shape: tuple[int, ...]) -> np.ndarray:
        """An uninitialised uint8 array; the next one of this name in this thread reuses its
        memory."""
        size = math.prod(shape)
        if name not in self._kept or self._kept[name].size < size:
            self._kept.pop(name, None)
            self._kept[name] = np.empty(size, np.uint8)
        return self._kept[name][:size].reshape(shape)
