#!/usr/bin/env bash
# sewar 0.4.10, `uqi`, the universal image quality index: its formula, which multiplies sums over a window by the
# number of pixels in it, is given means. What should be a covariance is 64 times the covariance plus 63 times the
# product of means, in windows of 8 by 8, and likewise the variances: noise and contents hardly change these.
# Expected of the index by its definition (means, variances, covariance), in the same windows: .79 for a picture
# with noise of 5 % and .00 for another picture. Seen: .99 and .89. A rendering that shows something else has a
# high quality. `d_lambda`, `d_s` and `qnr` rest on it.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet sewar==0.4.10 numpy==2.4.6 scipy==1.17.1
"$work/venv/bin/python" - <<'PROGRAM'
import numpy as np
from scipy.ndimage import gaussian_filter
from sewar.full_ref import uqi

WINDOW = 8
rng = np.random.default_rng(0)

def picture():
    smooth = gaussian_filter(rng.random((160, 192)), 3)
    return (255 * (smooth - smooth.min()) / (smooth.max() - smooth.min())).astype(np.uint8)

def by_definition(first, second):
    windows = [np.lib.stride_tricks.sliding_window_view(one.astype(float), (WINDOW, WINDOW)) for one in (first, second)]
    x, y = (one.reshape(-1, WINDOW**2) for one in windows)
    mean_x, mean_y = x.mean(1), y.mean(1)
    covariance = np.mean((x - mean_x[:, None]) * (y - mean_y[:, None]), 1)
    return np.mean(
        4 * covariance * mean_x * mean_y / ((x.var(1) + y.var(1)) * (mean_x**2 + mean_y**2))
    )

original, other = picture(), picture()
noisy = np.clip(original + rng.normal(scale=12.75, size=original.shape), 0, 255).astype(np.uint8)
for name, second in (("itself", original), ("noise of 5 %", noisy), ("another picture", other)):
    wanted, seen = by_definition(original, second), uqi(original, second, ws=WINDOW)
    print(f"{name}: {wanted:.3f} by the definition, {seen:.3f} by sewar")
    assert abs(seen - wanted) < 1e-9 if name == "itself" else seen > wanted + 0.15
PROGRAM
