"""LPIPS (Zhang et al., The Unreasonable Effectiveness of Deep Features, CVPR 2018), with weights
from files.

Nothing is downloaded. The weights are those of `torch.save(lpips.LPIPS(net="alex").state_dict(),
FILE)` in the authors' package (BSD-2-Clause), or two files: a backbone of torchvision
(`alexnet-…pth` or `vgg16-…pth`) and the authors' linear heads (`lpips/weights/v0.1/alex.pth`).
"""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gsba.log import GsbaError

_CHANNEL_MEANS, _CHANNEL_SIGMAS = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)  # constants of
# the authors, for values -1..1
_LAYERS = re.compile(r"(?:net\.slice\d+|features)\.(\d+)\.(weight|bias)$")
_HEADS = re.compile(r"(?:^|\.)lin(\d)\.model\.1\.weight$")
_ALEX = ((0, 4, 2), (3, 1, 2), (6, 1, 1), (8, 1, 1), (10, 1, 1))  # layer, stride, padding
_VGG = tuple((k, 1, 1) for k in (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28))
_POOLS = {"alex": (3, 6), "vgg": (5, 10, 17, 24)}  # layers preceded by a pooling
_TAPS = {"alex": (0, 3, 6, 8, 10), "vgg": (2, 7, 14, 21, 28)}  # layers whose activations are
# compared
_MIN_SIZE_PX = {"alex": 32, "vgg": 16}  # least pixels of an image that leave something to compare


class Lpips:
    """The LPIPS distance, on AlexNet or VGG16 as given by the weights.

    Args:
        paths: files of weights; see above.

    Raises:
        GsbaError: torch is not installed, or the files hold no such weights.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        try:
            import torch  # pyright: ignore[reportMissingImports]
        except ImportError:
            raise GsbaError("LPIPS needs torch: pip install 'gsba[splat]'") from None
        self._torch = torch
        names = ", ".join(map(str, paths))
        state = {
            name: value for path in paths for name, value in _read_weights(torch, path).items()
        }
        layers = {m.groups(): v.float() for n, v in state.items() if (m := _LAYERS.search(n))}
        self._heads = {int(m[1]): v.float() for n, v in state.items() if (m := _HEADS.search(n))}
        self.net = "vgg" if ("28", "weight") in layers else "alex"
        self._plan = _VGG if self.net == "vgg" else _ALEX
        missing = [k for k, *_ in self._plan if (str(k), "weight") not in layers]
        if missing:
            raise GsbaError(f"{names}: no weights of AlexNet or VGG16; see gsba.splat.lpips")
        if sorted(self._heads) != list(range(5)):
            raise GsbaError(f"{names}: the five linear heads of LPIPS are missing; add their file")
        self._layers = {
            int(k): (layers[str(k), "weight"], layers[str(k), "bias"]) for k, *_ in self._plan
        }
        taps = [self._layers[k][0].shape[0] for k in _TAPS[self.net]]
        if [self._heads[i].shape[1] for i in range(5)] != taps:
            raise GsbaError(f"{names}: the linear heads belong to another network than {self.net}")

    def __call__(
        self, image: np.ndarray, truth: np.ndarray, use: np.ndarray | None = None
    ) -> float:
        """Distance of two images; 0 for equal ones.

        Args:
            image, truth: (H, W, 3), values 0..1.
            use: (H, W) bool, pixels that count; the others count as equal in both images.

        Raises:
            GsbaError: the images are too small for the network.
        """
        torch, least = self._torch, _MIN_SIZE_PX[self.net]
        if min(image.shape[:2]) < least:
            raise GsbaError(f"LPIPS on {self.net} needs faces of {least} pixels or more")
        if use is not None:
            image = np.where(use[..., None], image, truth)
        with torch.inference_mode():
            pairs = zip(self._features(image), self._features(truth), strict=True)
            total = 0.0
            for i, (one, other) in enumerate(pairs):
                squares = (one - other) ** 2
                total += float(torch.nn.functional.conv2d(squares, self._heads[i]).mean())
        return total

    def _features(self, image: np.ndarray) -> list[Any]:
        """Activations (1, C, h, w) of the five layers, of unit length at every pixel."""
        torch, found = self._torch, []
        operations = torch.nn.functional
        x = 2 * torch.from_numpy(np.moveaxis(np.asarray(image, np.float32), -1, 0).copy())[None] - 1
        x = (x - torch.tensor(_CHANNEL_MEANS)[:, None, None]) / torch.tensor(_CHANNEL_SIGMAS)[
            :, None, None
        ]
        window = 3 if self.net == "alex" else 2
        for layer, stride, padding in self._plan:
            if layer in _POOLS[self.net]:
                x = operations.max_pool2d(x, window, 2)
            x = operations.relu(operations.conv2d(x, *self._layers[layer], stride, padding))
            if layer in _TAPS[self.net]:
                found.append(x / (x.pow(2).sum(dim=1, keepdim=True).sqrt() + 1e-10))
        return found


def _read_weights(torch: Any, path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise GsbaError(f"{path}: no such file of LPIPS weights")
    try:
        return dict(torch.load(path, map_location="cpu", weights_only=True))
    except Exception as error:  # pickle, zipfile and torch raise errors of many types
        raise GsbaError(f"{path}: not a file of weights; get it again") from error
