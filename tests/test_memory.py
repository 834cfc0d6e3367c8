"""What a thread has freed goes back to the system, where there is enough of it."""

import ctypes
import threading
from pathlib import Path

import numpy as np
import pytest

from gsba.memory import freed_memory_kept, give_back_freed_memory

pytestmark = pytest.mark.skipif(
    not hasattr(ctypes.CDLL(None), "mallinfo2"), reason="the C library does not tell what is free"
)
MANY, SIZE = 800, 100_000  # blocks of a thread, and bytes of each


def _resident() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


def test_freed_blocks_of_a_thread_go_back() -> None:
    kept = []

    def work() -> None:
        blocks = [np.ones(SIZE, np.uint8) for _ in range(MANY)]
        kept.append(blocks[-1])  # above all others: nothing goes back by itself

    with freed_memory_kept():
        thread = threading.Thread(target=work)
        thread.start()
        thread.join()
        held = _resident()
        give_back_freed_memory(least=1 << 40)
        assert _resident() > held - MANY * SIZE // 2
        give_back_freed_memory(least=MANY * SIZE // 2)
        assert _resident() < held - MANY * SIZE // 2
