"""Keypoints by kornia: ALIKED, DISK and XFeat, with weights in their authors' layouts."""

from pathlib import Path

import kornia.feature  # pyright: ignore[reportMissingImports]
import numpy as np
import torch  # pyright: ignore[reportMissingImports]

from gsba.learned.device import device, inference
from gsba.learned.interfaces import Detector
from gsba.learned.weights import load_into, read_state

# Of the layer by which ALIKED's models differ: channels and samples of a descriptor.
_ALIKED_MODELS = {(128, 16): "aliked-n16", (128, 32): "aliked-n32", (64, 16): "aliked-t16"}


def to_tensor(image: np.ndarray) -> torch.Tensor:
    """Tensor (1, 3, N, N) float32 in [0, 1] of an image (N, N, 3) uint8."""
    planes = np.moveaxis(image, -1, 0).astype(np.float32) / 255
    return torch.from_numpy(planes)[None].to(device())


def _arrays(*found: torch.Tensor) -> tuple[np.ndarray, ...]:
    return tuple(values.cpu().numpy() for values in found)


def aliked(weights: Path, num: int) -> Detector:
    """ALIKED (Zhao et al., TIM 2023), with subpixel keypoints; N(16), N(16) trained with rotations,
    N(32) or T(16), as the weights are."""
    state = read_state(weights)
    samples, channels = getattr(state.get("desc_head.agg_weights"), "shape", (16, 128, 128))[:2]
    name = _ALIKED_MODELS.get((channels, samples), "aliked-n16")
    # A threshold above 0 leaves most faces with a fraction of the keypoints that are wanted.
    model = kornia.feature.ALIKED(name, max_num_keypoints=num, detection_threshold=-1.0)
    model = load_into(model, state, "aliked", weights)

    def detect(image: np.ndarray) -> tuple[np.ndarray, ...]:
        with inference():
            found = model(to_tensor(image))[0]
        return _arrays(found.keypoints, found.keypoint_scores, found.descriptors)

    return detect


def disk(weights: Path, num: int) -> Detector:
    """DISK (Tyszkiewicz et al., NeurIPS 2020), with keypoints at whole pixels."""
    state = read_state(weights)
    model = load_into(kornia.feature.DISK(), state.get("extractor", state), "disk", weights)

    def detect(image: np.ndarray) -> tuple[np.ndarray, ...]:
        with inference():
            found = model(to_tensor(image), n=num)[0]
        return _arrays(found.keypoints, found.detection_scores, found.descriptors)

    return detect


def xfeat(weights: Path, num: int) -> Detector:
    """XFeat (Potje et al., CVPR 2024), with keypoints at whole pixels."""
    model = kornia.feature.XFeat(top_k=num).eval()
    load_into(model.net, read_state(weights), "xfeat", weights)

    def detect(image: np.ndarray) -> tuple[np.ndarray, ...]:
        with inference():
            found = model.detectAndCompute(to_tensor(image))[0]
        return _arrays(found["keypoints"], found["scores"], found["descriptors"])

    return detect
