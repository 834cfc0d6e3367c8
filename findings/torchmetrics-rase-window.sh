#!/usr/bin/env bash
# torchmetrics 1.9.0, the relative average spectral error (`RelativeAverageSpectralError`,
# `relative_average_spectral_error`): 100 times the RMS error over the mean of the target, in windows. Its mean
# filter gives means already, and these are divided by the number of pixels in a window once more.
# Expected of a picture and noise of a tenth of its mean: about 10 (percent), in windows of any size. Seen: 64
# times that, 640, of the default windows of 8 by 8; 16 times that of 4 by 4, 256 times of 16 by 16. (The example
# in the documentation has 5326.40 for two pictures of noise, 5326 % of their mean.)
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet torch==2.13.0 torchmetrics==1.9.0 numpy==2.4.6
"$work/venv/bin/python" - <<'PROGRAM'
import torch
from torchmetrics.functional.image import relative_average_spectral_error as rase

torch.manual_seed(0)
target = torch.rand(1, 3, 96, 128, dtype=torch.float64) * 0.1 + 0.45
preds = target + 0.05 * torch.randn_like(target)

def by_definition(window):
    """Means over windows of the target and of squared errors, and over bands; then over all windows."""
    mean, square = (
        torch.nn.functional.avg_pool2d(one, window, stride=1).mean(1) for one in (target, (preds - target) ** 2)
    )
    return float((100 * square.sqrt() / mean).mean())

for window in (4, 8, 16):
    wanted, seen = by_definition(window), float(rase(preds, target, window_size=window))
    print(f"windows of {window}: {wanted:.2f} % by the definition, {seen:.2f} seen, {seen / wanted:.1f} times as much")
    assert 8 < wanted < 11 and abs(seen / wanted / window**2 - 1) < 0.02, seen
PROGRAM
