"""The device that networks run on."""

import torch  # pyright: ignore[reportMissingImports]


def device() -> torch.device:
    """CUDA where torch can use a GPU, else the CPU."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")
