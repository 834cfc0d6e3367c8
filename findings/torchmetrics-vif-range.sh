#!/usr/bin/env bash
# torchmetrics 1.9.0, visual information fidelity (`VisualInformationFidelity`, `visual_information_fidelity`):
# its noise of the eye, a variance of 2, belongs to pixels from 0 to 255. There is no data_range, as its PSNR and
# SSIM have, and no word about the range; its own examples are pixels around 0 with a sigma of 1. Of pixels from
# 0 to 1, as renderers and trainers hold them, hardly more than their contrast counts.
# Expected: the same fidelity of a picture in any unit, 1 for the original. Seen of noise with a sigma of .1 and
# of .2: .99 and .92 by pixels from 0 to 1, .23 and .12 by the same times 255; of a contrast of 90 % .81 and .96.
# The order is the reverse.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet torch==2.13.0 torchmetrics==1.9.0 numpy==2.4.6 scipy==1.17.1
"$work/venv/bin/python" - <<'PROGRAM'
import numpy as np
import torch
from scipy.ndimage import gaussian_filter
from torchmetrics.functional.image import visual_information_fidelity as fidelity

rng = np.random.default_rng(0)
original = gaussian_filter(rng.random((192, 192)), 2)
original = (original - original.min()) / (original.max() - original.min())

def tensor(picture):
    return torch.tensor(picture)[None, None]

noise = rng.normal(size=original.shape)
pictures = {
    "noise of .1": np.clip(original + 0.1 * noise, 0, 1),
    "noise of .2": np.clip(original + 0.2 * noise, 0, 1),
    "contrast of 90 %": 0.9 * original + 0.05,
    "the original": original,
}
seen = {}
for name, picture in pictures.items():
    seen[name] = [float(fidelity(tensor(picture * top), tensor(original * top))) for top in (1, 255)]
    print("{}: {:.3f} by pixels from 0 to 1, {:.3f} by the same from 0 to 255".format(name, *seen[name]))
(noise_unit, noise_byte), (contrast_unit, contrast_byte) = seen["noise of .1"], seen["contrast of 90 %"]
assert noise_unit > 0.95 and contrast_unit < 0.85, seen
assert noise_byte < 0.3 and contrast_byte > 0.95, seen
assert np.allclose(seen["the original"], 1, atol=1e-4), seen
PROGRAM
