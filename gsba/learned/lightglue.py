"""LightGlue (Lindenberger et al., ICCV 2023) by kornia, on stored keypoints."""

import re
from pathlib import Path

import kornia.feature  # pyright: ignore[reportMissingImports]
import numpy as np
import torch  # pyright: ignore[reportMissingImports]

from gsba.features.detection import FaceKeypoints
from gsba.learned.device import device, inference
from gsba.learned.weights import load_into, read_state
from gsba.log import GsbaError

_DEPTH = 0.99  # share of keypoints whose match is certain, from which no more layers are applied:
# 98 % of the true matches in four fifths of the time; the published .95 loses 14 %
_UNUSED = re.compile(r"log_assignment\.\d+\.r")  # tensors of disk_lightglue.pth that nothing reads


class LightGlue:
    """Matcher of two faces with all keypoints, by as many layers as these need: of aliked, disk,
    superpoint, or xfeat ("LighterGlue", always by all), with weights in the layout of its authors
    or of kornia. GsbaError: the weights are of another network."""

    def __init__(self, extractor: str, weights: Path) -> None:
        wide = kornia.feature.LightGlue.features[extractor]
        chosen = {"depth_confidence": _DEPTH, **wide, "width_confidence": -1, "weights": None}
        chosen |= {"flash": False, "filter_threshold": 0.1}  # published value
        model = kornia.feature.LightGlue(None, **chosen)  # pyright: ignore[reportArgumentType]
        state = {name.removeprefix("matcher."): v for name, v in read_state(weights).items()}
        for block in ("self_attn", "cross_attn"):  # self_attn.3.x of the authors' files
            for layer in range(model.conf.n_layers):
                old, new = f"{block}.{layer}.", f"transformers.{layer}.{block}."
                state = {
                    new + name.removeprefix(old) if name.startswith(old) else name: value
                    for name, value in state.items()
                }
        parts = {name for name, _ in model.named_children()} | {"confidence_thresholds"}
        state = {
            name: value
            for name, value in state.items()
            if name.partition(".")[0] in parts
            and not (extractor == "disk" and _UNUSED.fullmatch(name))
        }
        self._length = model.conf.input_dim  # of a descriptor
        self._model = load_into(model, state, f"{extractor}-lightglue", weights)

    def __call__(
        self, first: FaceKeypoints, second: FaceKeypoints, size: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Matches (m, 2) of keypoints of two faces of `size` pixels, and their scores (m,).
        GsbaError: descriptors of another length than the network's (ALIKED-T16's)."""
        given, taken = first.descriptors.shape[1], self._length
        if given != taken:
            raise GsbaError(
                f"LightGlue takes descriptors of {taken} values, but features.weights gives "
                f"{given}: use another model, e.g. --weights aliked-n16.pth"
            )
        with inference():
            found = self._model({"image0": _image(first, size), "image1": _image(second, size)})
        return found["matches"][0].cpu().numpy(), found["scores"][0].cpu().numpy()


def _image(face: FaceKeypoints, size: int) -> dict[str, torch.Tensor]:
    """Input of LightGlue for a face, with pixels from the centre of the first."""
    pixels = np.clip(face.pixels - 0.5, 0, size - 1).astype(np.float32)
    return {
        "keypoints": torch.from_numpy(pixels)[None].to(device()),
        "descriptors": torch.from_numpy(face.descriptors)[None].to(device()),
        "image_size": torch.tensor([[size, size]], device=device()),
    }
