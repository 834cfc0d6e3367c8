"""Abilities of the extras' packages on this machine, found in the process that imported them."""

import shutil
from importlib.util import find_spec
from pathlib import Path
from typing import Any

CODECS = ("h264", "hevc", "av1", "vp9", "prores", "mjpeg")


def video() -> dict[str, Any]:
    """Common codecs, with True for those that PyAV can decode."""
    import av.codec

    return {"codecs": {name: _decodes(av.codec.Codec, name) for name in CODECS}}


def _decodes(codec: Any, name: str) -> bool:
    try:
        return bool(codec(name, "r"))
    except ValueError:
        return False


def splat() -> dict[str, Any]:
    """CUDA support of torch and gsplat, without building kernels."""
    import torch  # pyright: ignore[reportMissingImports]

    usable = torch.cuda.is_available()
    return {
        "torch_cuda": torch.version.cuda,  # None = built for the CPU only
        "devices": [torch.cuda.get_device_name(k) for k in range(torch.cuda.device_count())]
        if usable
        else [],
        "driver": any(Path("/dev").glob("nvidia[0-9]*")),
        "kernels": find_spec("gsplat.csrc") is not None,
        "compiler": shutil.which("nvcc"),
    }


def learned() -> dict[str, Any]:
    """Networks whose weights are at hand, with their licences."""
    from gsba.learned.weights import SOURCES, weights_at_hand

    return {"weights": [f"{key} ({SOURCES[key].licence})" for key in sorted(weights_at_hand())]}


def scan() -> dict[str, Any]:
    """True under "laz" if compressed laser scans (LAZ) can be read."""
    if find_spec("laspy") is None:
        return {}
    import laspy  # pyright: ignore[reportMissingImports]

    return {"laz": bool(laspy.LazBackend.detect_available())}
