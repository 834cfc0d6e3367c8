"""Keypoints by kornia: ALIKED, DISK and XFeat, with weights in their authors' layouts."""

from pathlib import Path

import kornia.feature  # pyright: ignore[reportMissingImports]
import numpy as np
import torch  # pyright: ignore[reportMissingImports]

from gsba.learned.interfaces import Detector
from gsba.learned.weights import load_into, read_state


def to_tensor(image: np.ndarray) -> torch.Tensor:
    """Tensor (1, 3, N, N) float32 in [0, 1] of an image (N, N, 3) uint8."""
    return torch.from_numpy(np.moveaxis(image, -1, 0).astype(np.float32) / 255)[None]


def aliked(weights: Path, num: int) -> Detector:
    """ALIKED-N(16) (Zhao et al., TIM 2023), with subpixel keypoints."""
    model = kornia.feature.ALIKED("aliked-n16", max_num_keypoints=num)
    model = load_into(model, read_state(weights), "aliked", weights)

    def detect(image: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        with torch.inference_mode():
            found = model(to_tensor(image))[0]
        return found.keypoints.numpy(), found.keypoint_scores.numpy(), found.descriptors.numpy()

    return detect


def disk(weights: Path, num: int) -> Detector:
    """DISK (Tyszkiewicz et al., NeurIPS 2020), with keypoints at whole pixels."""
    state = read_state(weights)
    model = load_into(kornia.feature.DISK(), state.get("extractor", state), "disk", weights)

    def detect(image: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        with torch.inference_mode():
            found = model(to_tensor(image), n=num)[0]
        return found.keypoints.numpy(), found.detection_scores.numpy(), found.descriptors.numpy()

    return detect


def xfeat(weights: Path, num: int) -> Detector:
    """XFeat (Potje et al., CVPR 2024), with keypoints at whole pixels."""
    model = kornia.feature.XFeat(top_k=num).eval()
    load_into(model.net, read_state(weights), "xfeat", weights)

    def detect(image: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        with torch.inference_mode():
            found = model.detectAndCompute(to_tensor(image))[0]
        return found["keypoints"].numpy(), found["scores"].numpy(), found["descriptors"].numpy()

    return detect
