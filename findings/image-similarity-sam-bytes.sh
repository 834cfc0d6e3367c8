#!/usr/bin/env bash
# image-similarity-measures 0.3.6, `sam`, the spectral angle between two pictures: the products of their values
# are computed in the pictures' own type. Of bytes, which its command line reads from files, they
# begin again at 0 beyond 255.
# Expected: the same angle for bytes and for floats of the same values, 0 degrees of a picture to itself. Seen of
# noise of 5 %: 3.8 degrees as floats, 89.6 as bytes; and 89.7 of a picture to itself, without a warning.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet image-similarity-measures==0.3.6
"$work/venv/bin/python" - <<'PROGRAM'
import numpy as np
from image_similarity_measures.quality_metrics import sam

rng = np.random.default_rng(0)
original = rng.integers(60, 220, (160, 192, 3)).astype(np.uint8)
noisy = np.clip(original + rng.normal(scale=12.75, size=original.shape), 0, 255).astype(np.uint8)

def by_definition(first, second):
    first, second = first.astype(float), second.astype(float)
    cosines = (first * second).sum(-1) / np.linalg.norm(first, axis=-1) / np.linalg.norm(second, axis=-1)
    return np.degrees(np.arccos(np.clip(cosines, -1, 1))).mean()

for name, second in (("itself", original), ("noise of 5 %", noisy)):
    wanted = by_definition(original, second)
    floats, bytes_ = sam(original.astype(float), second.astype(float)), sam(original, second)
    print(f"{name}: {wanted:.2f} degrees by the definition, {floats:.2f} of floats, {bytes_:.2f} of bytes")
    assert abs(floats - wanted) < 1e-6 and bytes_ > 80, bytes_
PROGRAM
