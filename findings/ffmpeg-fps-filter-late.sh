#!/usr/bin/env bash
# FFmpeg 9.0.2 (imageio-ffmpeg 0.8.1), pictures taken from a video at a lower rate by `-vf fps=1`: picture n is
# stamped n seconds and shows what was filmed almost half a second later. The filter rounds the time of each
# frame to a step, and of the frames of one step it keeps the last. So a place by GPS or a rate by IMU at n
# seconds belongs to another frame, by .47 s at one picture a second: .7 m of a walk.
# Expected of 30 frames a second: frames 0, 30, 60. Seen by fps=1: 14, 44, 74; by fps=2, instead of 0, 15, 30:
# 7, 22, 37. `fps=1:round=up` takes the expected ones. The option `-r 2` takes 0, 1, 13, 28: two frames in a row
# first, and from then on each picture is half a second and more before its stamp.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet imageio-ffmpeg==0.8.1 numpy==2.4.6
cd "$work"
"$work/venv/bin/python" - <<'PROGRAM'
import subprocess

import imageio_ffmpeg
import numpy as np

FFMPEG, RATE, FRAMES = imageio_ffmpeg.get_ffmpeg_exe(), 30, 240
RAW = ["-f", "rawvideo", "-pix_fmt", "gray"]

def ffmpeg(*options, data=None):
    command = [FFMPEG, "-loglevel", "error", *options]
    return subprocess.run(command, input=data, stdout=subprocess.PIPE, check=True).stdout

grey_is_number = np.repeat(np.arange(FRAMES, dtype=np.uint8), 16 * 16).tobytes()
ffmpeg(*RAW, "-s", "16x16", "-r", str(RATE), "-i", "-", "-c:v", "ffv1", "video.mkv", data=grey_is_number)

def taken(*options):
    """Numbers of the frames that become pictures."""
    pictures = np.frombuffer(ffmpeg("-i", "video.mkv", *options, *RAW, "-"), np.uint8)
    return pictures.reshape(-1, 256)[:, 0].astype(int)

def late(numbers, rate):
    """Seconds from each picture's stamp to the time of its frame."""
    return numbers / RATE - np.arange(len(numbers)) / rate

for rate, seconds in ((1, 14 / 30), (2, 7 / 30)):
    numbers, upwards = taken("-vf", f"fps={rate}"), taken("-vf", f"fps={rate}:round=up")
    print(f"fps={rate}: frames {numbers[:4]}, late by {late(numbers, rate).mean():.3f} s; "
          f"with round=up {upwards[:4]}")
    assert len(numbers) == FRAMES // RATE * rate and np.allclose(late(numbers, rate), seconds), numbers
    assert np.allclose(late(upwards, rate), 0), upwards

numbers = taken("-r", "2")
print(f"-r 2: frames {numbers[:6]}, late by {late(numbers, 2)[:6].round(3)} s")
assert list(numbers[:4]) == [0, 1, 13, 28] and np.allclose(late(numbers, 2)[2:-1], -17 / 30, atol=1e-6), numbers
PROGRAM
