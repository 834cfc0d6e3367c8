"""Similarity of two images: PSNR, SSIM, and the training loss of L1 and SSIM.

SSIM as of Wang et al., Image Quality Assessment: From Error Visibility to Structural Similarity,
2004: an 11 x 11 Gaussian window of sigma 1.5, K1 = 0.01, K2 = 0.03, values 0..1.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

_Image = Any  # an array of NumPy or PyTorch
_WINDOW_RADIUS_PX, _WINDOW_SIGMA_PX = 5, 1.5
_C1, _C2 = 0.01**2, 0.03**2


def psnr(image: np.ndarray, truth: np.ndarray, use: np.ndarray | None = None) -> float:
    """Peak signal-to-noise ratio in dB over all pixels of images (..., C), values 0..1, that are in
    `use (...)`, at least one, None = all; inf for equal images."""
    error = (np.asarray(image, np.float64) - truth) ** 2
    mean = float(np.mean(error if use is None else error[use]))
    return float("inf") if mean == 0 else -10 * float(np.log10(mean))


def ssim(image: np.ndarray, truth: np.ndarray, use: np.ndarray | None = None) -> float:
    """Mean structural similarity of images (H, W, C), values 0..1, at least 11 pixels high and
    wide, over the pixels whose window lies inside. Pixels not in `use (H, W)` count as equal in
    both, and NaN is returned if no pixel with a whole window counts."""
    x, y = np.asarray(image, np.float64), np.asarray(truth, np.float64)
    if use is not None:
        x = np.where(use[..., None], x, y)
    inner = (slice(_WINDOW_RADIUS_PX, -_WINDOW_RADIUS_PX),) * 2
    values = similarity(x, y, _blur)[0][inner].mean(axis=-1)
    if use is not None:
        values = values[use[inner]]
    return float(values.mean()) if values.size else float("nan")


def training_loss(
    image: np.ndarray, truth: np.ndarray, use: np.ndarray | None, ssim_weight: float
) -> tuple[float, np.ndarray]:
    """The loss (1 - w) L1 + w (1 - SSIM) of 3DGS for images (H, W, C) float32, and its derivative
    by the first. SSIM is computed at every pixel, with black around the image, like the published
    trainer; pixels not in `use (H, W)` are black in both."""
    if use is not None:
        image, truth = image * use[..., None], truth * use[..., None]
    difference = image - truth
    values, slope = similarity(image, truth, _blur)
    loss = (1 - ssim_weight) * np.abs(difference).mean() + ssim_weight * (1 - values.mean())
    slope = ((1 - ssim_weight) * np.sign(difference) - ssim_weight * slope) / image.size
    if use is not None:
        slope *= use[..., None]
    return float(loss), slope.astype(np.float32)


def similarity(x: _Image, y: _Image, blur: Callable[[_Image], _Image]) -> tuple[_Image, _Image]:
    """SSIM (H, W, C) at every pixel of images of NumPy or PyTorch, and the derivative (H, W, C) of
    its sum by x; blur: by `window` along both axes, with black around the image. The window is its
    own adjoint, so that the derivative takes three more passes of it."""
    mean_x, mean_y = blur(x), blur(y)
    a1, b1 = 2 * mean_x * mean_y + _C1, mean_x**2 + mean_y**2 + _C1
    a2 = 2 * (blur(x * y) - mean_x * mean_y) + _C2
    b2 = blur(x * x) + blur(y * y) - mean_x**2 - mean_y**2 + _C2
    values = a1 * a2 / (b1 * b2)
    by_square, by_product = -values / b2, 2 * a1 / (b1 * b2)
    by_mean = 2 * mean_y * a2 / (b1 * b2) - 2 * mean_x * values / b1
    by_mean -= by_product * mean_y + 2 * by_square * mean_x
    return values, blur(by_mean) + 2 * x * blur(by_square) + y * blur(by_product)


def window() -> np.ndarray:
    """Weights (11,) float64 of the window along one axis."""
    import cv2

    return cv2.getGaussianKernel(2 * _WINDOW_RADIUS_PX + 1, _WINDOW_SIGMA_PX)[:, 0]


def _blur(image: np.ndarray) -> np.ndarray:
    import cv2

    size = (2 * _WINDOW_RADIUS_PX + 1, 2 * _WINDOW_RADIUS_PX + 1)
    return cv2.GaussianBlur(image, size, _WINDOW_SIGMA_PX, borderType=cv2.BORDER_CONSTANT)
