#!/usr/bin/env bash
# FFmpeg 9.0.2 (imageio-ffmpeg 0.8.1), filter v360 with its default, bilinear interpolation, of pictures with
# 16 bits a channel: the weights of the four pixels, as integers, can add up to more than one, and a sum beyond
# 65535 begins again at 0. What is white becomes black: clipped skies, masks, the far end of depths.
# Expected of a turned white panorama: white. Seen: 83 % of its pixels are black (2 or 6 of 65535), in gray16,
# rgb48 and gbrp16. Values up to 65528, the other interpolations (cubic) and 8 or 12 bits have none.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet imageio-ffmpeg==0.8.1 numpy==2.4.6
"$work/venv/bin/python" - <<'PROGRAM'
import subprocess

import imageio_ffmpeg
import numpy as np

WIDTH, HEIGHT = 512, 256

def turned(value, pixels="gray16le", options=""):
    """Values of a panorama of one value that is turned by 10 and 5 degrees."""
    raw = ["-f", "rawvideo", "-pix_fmt", pixels]
    planes = 1 if pixels.startswith("gray") else 3
    panorama = np.full(planes * WIDTH * HEIGHT, value, np.uint8 if pixels == "gray" else "<u2")
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error"]
    command += [*raw, "-s", f"{WIDTH}x{HEIGHT}", "-i", "-"]
    command += ["-vf", f"v360=e:e:yaw=10:pitch=5{options}", *raw, "-"]
    result = subprocess.run(command, input=panorama.tobytes(), stdout=subprocess.PIPE, check=True).stdout
    return np.frombuffer(result, panorama.dtype).astype(int)

for pixels in ("gray16le", "rgb48le", "gbrp16le"):
    white = turned(65535, pixels)
    print(f"white as {pixels}: {(white < 100).mean():.1%} black, values {np.unique(white)}")
    assert (white < 100).mean() > 0.5 and white.max() == 65535
for case in ((65528,), (65535, "gray16le", ":interp=cubic"), (4095, "gbrp12le"), (255, "gray")):
    seen = turned(*case)
    print(f"{case}: values from {seen.min()} to {seen.max()}")
    assert seen.min() > 0.99 * case[0], case
PROGRAM
