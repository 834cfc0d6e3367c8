"""What a thread has freed goes back to the system, where there is enough of it."""

import ctypes
import threading
from pathlib import Path

import numpy as np
import pytest

from gsba import memory
from gsba.memory import freed_memory_kept, give_back_freed_memory, total_memory_bytes

glibc = pytest.mark.skipif(
    not hasattr(ctypes.CDLL(None), "mallinfo2"), reason="the C library does not tell what is free"
)
MANY, SIZE = 800, 100_000  # blocks of a thread, and bytes of each


def _resident() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


@glibc
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


@pytest.mark.parametrize(
    ("groups", "files", "expected"),
    [
        ("0::/job/step\n", {"job/step/memory.max": "max", "job/memory.max": "4096"}, [4096]),
        ("0::/\n", {"memory.max": "2048\n"}, [2048]),
        (
            "4:memory:/a\n3:cpu:/b\n0::/\n",
            {"memory/a/memory.limit_in_bytes": "512", "memory/memory.limit_in_bytes": "1024"},
            [512, 1024],
        ),
        ("0::/gone\n", {}, []),
        ("damaged\n", {}, []),
    ],
)
def test_a_container_has_the_memory_that_its_control_group_allows(
    groups: str, files: dict[str, str], expected: list[int], tmp_path: Path
) -> None:
    (tmp_path / "proc/self").mkdir(parents=True)
    (tmp_path / "proc/self/cgroup").write_text(groups)
    for name, content in files.items():
        path = tmp_path / "sys/fs/cgroup" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content)
    assert memory._limits_of_control_groups(tmp_path) == expected
    assert total_memory_bytes() > 0
