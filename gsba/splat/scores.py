"""Similarity of renderings of a splat to captured pictures: PSNR, SSIM, LPIPS of panoramas."""

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gsba.log import GsbaError
from gsba.splat.backend import Backend
from gsba.splat.gaussians import Gaussians
from gsba.splat.metrics import psnr, ssim
from gsba.splat.options import TrainingOptions
from gsba.splat.train import Views

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
    """The LPIPS distance (Zhang et al., The Unreasonable Effectiveness of Deep Features, CVPR
    2018), on AlexNet or VGG16 as given by files of weights; nothing is downloaded.

    They are those of `torch.save(lpips.LPIPS(net="alex").state_dict(), FILE)` in the authors'
    package (BSD-2-Clause), or two files: a backbone of torchvision (`alexnet-…pth` or `vgg16-…pth`)
    and the authors' linear heads (`lpips/weights/v0.1/alex.pth`). GsbaError: torch is not
    installed, or the files hold no such weights.
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
            raise GsbaError(f"{names}: no weights of AlexNet or VGG16; see gsba.splat.scores")
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
        """Distance of two images (H, W, 3), values 0..1; 0 for equal ones. Pixels not in `use (H,
        W)` count as equal in both. GsbaError: the images are too small for the network."""
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


Distance = Callable[[np.ndarray, np.ndarray, np.ndarray | None], float]


@dataclass(frozen=True, slots=True)
class Score:
    """Similarity of renderings of a panorama's six faces to the captured ones."""

    psnr: float  # dB, over the pixels of all faces together
    ssim: float  # mean over faces
    psnr_exposed: float  # dB, after fitting a gain for each channel
    lpips: float | None = None  # mean over faces; None = no weights were given


def measure(
    gaussians: Gaussians,
    views: Views,
    settings: TrainingOptions,
    near: float,
    backend: Backend,
    lpips: Distance | None = None,
) -> dict[int, Score]:
    """Scores of panoramas, by their number in the views.

    Args:
        views: held-out faces; a panorama that is masked altogether has no faces and no score.
        settings: degree of the harmonics.
        near: least z of a Gaussian, map units.
        lpips: see `gsba.splat.scores`; None = not measured.

    Raises:
        GsbaError: no panorama has a pixel to measure.
    """
    given = settings, near, backend
    return {
        int(views.panoramas[rows[0]]): _score(_pairs(gaussians, views, rows, *given), lpips)
        for rows in _panoramas(views)
    }


def face_psnrs(
    gaussians: Gaussians, views: Views, settings: TrainingOptions, near: float, backend: Backend
) -> np.ndarray:
    """PSNR of each view (V,) in dB, after fitting a gain for each channel of its panorama.

    Args:
        gaussians, views, settings, near, backend: see `measure`.

    Raises:
        GsbaError: no panorama has a pixel to measure.
    """
    found = np.zeros(len(views.cameras))
    for rows in _panoramas(views):
        pairs = _pairs(gaussians, views, rows, settings, near, backend)
        gains = _gains(
            [image[use] for image, _, use in pairs], [real[use] for _, real, use in pairs]
        )
        for v, (image, real, use) in zip(rows, pairs, strict=True):
            # dB: rounding to 8 bits alone leaves 59
            found[v] = min(psnr(np.clip(gains * image, 0, 1), real, use), 60.0)
    return found


def _score(
    pairs: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]], lpips: Distance | None
) -> Score:
    found, truth, similarities, distances = [], [], [], []
    for image, real, use in pairs:
        similarities.append(ssim(image, real, use))
        if lpips is not None:
            distances.append(lpips(image, real, use))
        found.append(image[use])
        truth.append(real[use])
    gains = _gains(found, truth)
    image, real = np.concatenate(found), np.concatenate(truth)
    exposed = psnr(np.clip(gains * image, 0, 1), real)
    far = float(np.mean(distances)) if distances else None
    return Score(psnr(image, real), float(np.nanmean(similarities)), exposed, far)


def mean_score(scores: Iterable[Score]) -> Score:
    """Mean of each metric over panoramas."""
    scores = list(scores)
    columns = ((s.psnr, s.ssim, s.psnr_exposed) for s in scores)
    distances = [s.lpips for s in scores if s.lpips is not None]
    far = float(np.mean(distances)) if distances else None
    means = Score(*(float(np.mean(column)) for column in zip(*columns, strict=True)))
    return replace(means, lpips=far)


def _panoramas(views: Views) -> list[np.ndarray]:
    """Rows of the views of each panorama."""
    if len(views.cameras) == 0:
        raise GsbaError("no pixel to measure a splat on: all held-out frames are masked")
    return [np.flatnonzero(views.panoramas == i) for i in np.unique(views.panoramas)]


def _pairs(
    gaussians: Gaussians,
    views: Views,
    rows: np.ndarray,
    settings: TrainingOptions,
    near: float,
    backend: Backend,
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Rendering and truth (H, W, 3) float32, 0..1, and mask (H, W) bool of each view."""
    cameras = [views.cameras[v] for v in rows]
    renderings = backend.render(gaussians, cameras, settings.sh_degree, near)
    pairs = []
    for v, rendering in zip(rows, renderings, strict=True):
        image, real = np.clip(rendering.color, 0, 1), views.images[v].astype(np.float32) / 255
        use = np.ones(real.shape[:2], bool) if views.use is None else views.use[v]
        pairs.append((image, real, use))
    return pairs


def _gains(images: Sequence[np.ndarray], truths: Sequence[np.ndarray]) -> np.ndarray:
    """Gain of each channel (3,) that minimises the distance of pixels (N, 3) to their truth."""
    image, real = np.concatenate(images), np.concatenate(truths)
    return np.sum(image * real, axis=0) / np.maximum(np.sum(image * image, axis=0), 1e-9)
