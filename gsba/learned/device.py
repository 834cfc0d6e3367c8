"""The device that networks run on, and the threads of a CPU that they take."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch  # pyright: ignore[reportMissingImports]

_THREADS = torch.get_num_threads()


def device() -> torch.device:
    """CUDA where torch can use a GPU, else the CPU."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


@contextmanager
def inference() -> Iterator[None]:
    """Inference on one thread of the CPU: a run calls networks from as many threads as it has
    cores, and torch's own threads would wait for one another there, five times as long."""
    torch.set_num_threads(1)
    try:
        with torch.inference_mode():
            yield
    finally:
        torch.set_num_threads(_THREADS)
