"""Similarity of renderings of a splat to captured pictures: PSNR, SSIM, LPIPS of panoramas."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsba.config import SplatSettings
from gsba.log import GsbaError
from gsba.splat.backend import Backend
from gsba.splat.gaussians import Gaussians
from gsba.splat.metrics import psnr, ssim
from gsba.splat.train import Views

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
    settings: SplatSettings,
    near: float,
    backend: Backend,
    lpips: Distance | None = None,
) -> dict[int, Score]:
    """Scores of panoramas, by their number in the views.

    Args:
        gaussians: the splat.
        views: held-out faces; a panorama that is masked altogether has no faces and no score.
        settings: degree of the harmonics.
        near: least z of a Gaussian, map units.
        backend: the renderer.
        lpips: see `gsba.splat.lpips`; None = not measured.

    Raises:
        GsbaError: no panorama has a pixel to measure.
    """
    given = settings, near, backend
    return {
        int(views.panoramas[rows[0]]): _score(_pairs(gaussians, views, rows, *given), lpips)
        for rows in _panoramas(views)
    }


def face_psnrs(
    gaussians: Gaussians, views: Views, settings: SplatSettings, near: float, backend: Backend
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
    settings: SplatSettings,
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
