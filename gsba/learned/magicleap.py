"""SuperPoint and SuperGlue by transformers; weights, in the authors' layout or of transformers,
under Magic Leap's non-commercial licence."""

import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch  # pyright: ignore[reportMissingImports]
from transformers import (  # pyright: ignore[reportMissingImports]
    SuperGlueConfig,
    SuperGlueForKeypointMatching,
    SuperPointConfig,
    SuperPointForKeypointDetection,
)

from gsba.features.detection import FaceKeypoints
from gsba.learned.device import device, inference
from gsba.learned.interfaces import Detector
from gsba.learned.weights import load_into, read_state

_HEAD_NAMES = {  # layer of superpoint_v1.pth -> layer of transformers
    "convPa": "keypoint_decoder.conv_score_a",
    "convPb": "keypoint_decoder.conv_score_b",
    "convDa": "descriptor_decoder.conv_descriptor_a",
    "convDb": "descriptor_decoder.conv_descriptor_b",
}


def superpoint(weights: Path, num: int) -> Detector:
    """SuperPoint (DeTone et al., CVPRW 2018), with keypoints at whole pixels."""
    model = SuperPointForKeypointDetection(SuperPointConfig(max_keypoints=num))
    state = {_superpoint_name(name): value for name, value in read_state(weights).items()}
    model = load_into(model, state, "superpoint", weights)

    def detect(image: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32) / 255
        with inference():
            found = model(pixel_values=torch.from_numpy(grey)[None, None].to(device()))
        keypoints, scores, descriptors = (
            values[0].cpu().numpy() for values in (found.keypoints, found.scores, found.descriptors)
        )
        return np.rint(keypoints * image.shape[0]), scores, descriptors  # relative to the size

    return detect


def _superpoint_name(name: str) -> str:
    """Name in transformers of a tensor of superpoint_v1.pth; other names are kept."""
    layer, _, kind = name.partition(".")
    found = re.fullmatch(r"conv([1-4])([ab])", layer)
    if found:
        return f"encoder.conv_blocks.{int(found[1]) - 1}.conv_{found[2]}.{kind}"
    return f"{_HEAD_NAMES[layer]}.{kind}" if layer in _HEAD_NAMES else name


class SuperGlue:
    """SuperGlue (Sarlin et al., CVPR 2020) between SuperPoint keypoints of two faces, with weights
    of either layout. GsbaError: they are of another network."""

    def __init__(self, weights: Path) -> None:
        model = SuperGlueForKeypointMatching(SuperGlueConfig(matching_threshold=0.2))
        model.keypoint_detector = torch.nn.Identity()  # keypoints are detected once per frame
        state = read_state(weights)
        if "kenc.encoder.0.weight" in state:
            state = dict(_superglue_tensor(*item) for item in state.items())
        state = {n: v for n, v in state.items() if not n.startswith("keypoint_detector.")}
        self._model = load_into(model, state, "superpoint-superglue", weights)

    def __call__(
        self, first: FaceKeypoints, second: FaceKeypoints, size: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Matches (m, 2) of keypoints of two faces of `size` pixels, and their scores (m,)."""
        n0, n1 = len(first.pixels), len(second.pixels)
        mask = torch.zeros((1, 2, max(n0, n1)), dtype=torch.int)
        mask[0, 0, :n0] = mask[0, 1, :n1] = 1
        with inference():
            matches, scores = self._model._match_image_pair(
                _together(first.pixels - 0.5, second.pixels - 0.5),
                _together(first.descriptors, second.descriptors),
                _together(_scores(first), _scores(second)),
                size,
                size,
                mask=mask.to(device()),
            )[:2]
        partners = matches[0, 0, :n0].cpu().numpy()
        rows = np.flatnonzero((partners >= 0) & (partners < n1))
        return np.column_stack([rows, partners[rows]]), scores[0, 0].cpu().numpy()[rows]


def _scores(face: FaceKeypoints) -> np.ndarray:
    assert face.scores is not None, "SuperPoint gives every keypoint a score"
    return face.scores


def _together(first: np.ndarray, second: np.ndarray) -> torch.Tensor:
    """Tensor (1, 2, n, ...) float32 of both faces' rows, the shorter one padded with zeros."""
    longest = max(len(first), len(second))
    both = np.zeros((1, 2, longest, *first.shape[1:]), np.float32)
    both[0, 0, : len(first)], both[0, 1, : len(second)] = first, second
    return torch.from_numpy(both).to(device())


def _superglue_tensor(name: str, value: Any) -> tuple[str, Any]:
    """Name and tensor in transformers of a tensor of superglue_outdoor.pth.

    The authors' layers are convolutions over points, and the head is the fastest index of their
    channels; those of transformers are matrices with the head as the slowest index.
    """
    parts = name.split(".")
    if value.ndim == 3:
        value = value[..., 0]
    if parts[0] == "final_proj":
        return f"final_projection.{name}", value
    if parts[0] == "kenc":
        return f"keypoint_encoder.encoder.{_in_stack(int(parts[2]), 12, parts[3])}", value
    if parts[0] != "gnn":
        return name, value
    layer = f"gnn.layers.{parts[2]}"
    if parts[3] == "mlp":
        return f"{layer}.mlp.{_in_stack(int(parts[4]), 3, parts[5])}", value
    if parts[4] == "merge":
        return f"{layer}.attention.output.dense.{parts[5]}", _by_head(value.T).T if (
            parts[5] == "weight"
        ) else value
    projection = ("query", "key", "value")[int(parts[5])]
    return f"{layer}.attention.self.{projection}.{parts[6]}", _by_head(value)


def _in_stack(index: int, last: int, kind: str) -> str:
    """Name of layer `index` in a stack of (linear, norm, ReLU) that ends in a linear layer."""
    if index == last:
        return f"{index // 3}.{kind}"
    return f"{index // 3}.{('linear', 'batch_norm')[index % 3]}.{kind}"


def _by_head(value: Any) -> Any:
    """Rows reordered from (channel, head) to (head, channel)."""
    return value.unflatten(0, (-1, 4)).transpose(0, 1).flatten(0, 1)  # of SuperGlue's attention
