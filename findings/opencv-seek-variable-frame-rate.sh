#!/usr/bin/env bash
# OpenCV 5.0.0.93, VideoCapture: `set(CAP_PROP_POS_FRAMES, n)` in a video whose frame rate varies, as phones
# record in the dark, goes about to the time n / mean rate, not to frame n; `get` reports that it is at n.
# Expected: the frame that n calls of read() come to, as at a constant rate. Seen of 60 frames at 30 and
# 60 at 15 frames per second: 93 of 120 are others, 50 is frame 66, up to 20 frames (1.33 s) away, and
# there is no picture for the last eight. Poses of frames that were read in turn belong to other pictures
# as soon as the pictures are fetched by number.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet opencv-python-headless==5.0.0.93 av==18.0.0 numpy==2.4.6
cd "$work"
"$work/venv/bin/python" - <<'PROGRAM'
from fractions import Fraction
import av
import numpy as np

TICK = Fraction(1, 90000)

def picture(number):
    """Picture that shows its number in stripes, one a bit."""
    stripes = 255 * np.unpackbits(np.array([number], np.uint8))
    return np.broadcast_to(np.repeat(stripes, 16)[None, :, None], (64, 128, 3)).astype(np.uint8)

def number_in(picture):
    return int(np.packbits(picture[32, 8::16, 0] > 127)[0])

rates = {"constant.mp4": [3000] * 119, "varying.mp4": [3000] * 60 + [6000] * 59}
for name, steps in rates.items():
    with av.open(name, "w") as made:
        stream = made.add_stream("libx264", rate=30, options={"bf": "0", "g": "30"})
        stream.width, stream.height, stream.pix_fmt = 128, 64, "yuv420p"
        stream.time_base = stream.codec_context.time_base = TICK
        for number, tick in enumerate(np.cumsum([0] + steps)):
            frame = av.VideoFrame.from_ndarray(picture(number))
            frame.pts, frame.time_base = int(tick), TICK
            made.mux(stream.encode(frame))
        made.mux(stream.encode())

import cv2

for name, steps in rates.items():
    capture, in_turn = cv2.VideoCapture(name, cv2.CAP_FFMPEG), []
    while (one := capture.read())[0]:
        in_turn.append(number_in(one[1]))
    assert in_turn == list(range(120)) and capture.get(cv2.CAP_PROP_FRAME_COUNT) == 120, in_turn
    seen = {}  # numbers of the frames that come
    for number in range(120):
        assert capture.set(cv2.CAP_PROP_POS_FRAMES, number)
        reported = capture.get(cv2.CAP_PROP_POS_FRAMES)
        good, one = capture.read()
        if good:
            assert reported == number, reported
            seen[number] = number_in(one)
    times = np.cumsum([0] + steps) / 90000
    asked, came = np.array(list(seen.items())).T
    frames, seconds = abs(came - asked), abs(times[came] - times[asked])
    print(f"{name}: asked for 40, 50, 70 and 90, got {[seen[n] for n in (40, 50, 70, 90)]}; "
          f"{(frames > 0).sum()} of 120 are others, up to {frames.max()} frames and {seconds.max():.2f} s "
          f"away, and {120 - len(seen)} are none")
    if name == "constant.mp4":
        assert len(seen) == 120 and not frames.any(), frames
    else:
        assert (frames > 0).sum() > 60 and frames.max() > 9 and seconds.max() > 0.4, frames
PROGRAM
