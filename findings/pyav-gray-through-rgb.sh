#!/usr/bin/env bash
# PyAV 18.0.0: `frame.reformat(format="gray")` of a YUV frame that is tagged BT.709, as every HD
# camera writes, is not the frame's own luma plane. It is converted to RGB by BT.709's matrix and
# back by BT.601's: other grey values, at twice the time and more. Of an untagged frame it is the
# plane, to a grey level.
# Seen: a frame of saturated green whose plane holds 120 is 121 if untagged, 102 if tagged.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet av==18.0.0 numpy==2.4.6
"$work/venv/bin/python" - <<'PROGRAM'
import time
import av
import numpy as np
from av.video.reformatter import Colorspace

def frame(tagged):
    made = av.VideoFrame(1920, 1088, "yuv420p")
    for plane, value in zip(made.planes, (120, 60, 70)):
        plane.update(np.full(plane.buffer_size, value, np.uint8).tobytes())
    if tagged:
        made.colorspace = Colorspace.ITU709
    return made

def grey(one):
    return int(one.reformat(format="gray").to_ndarray()[500, 500])

untagged, tagged = grey(frame(False)), grey(frame(True))
print(f"luma plane 120; gray of the untagged frame {untagged}, of the tagged one {tagged}")

def seconds(one):
    start = time.process_time()
    for _ in range(20):
        one.reformat(format="gray")
    return time.process_time() - start

ratio = min(seconds(frame(True)) for _ in range(3)) / min(seconds(frame(False)) for _ in range(3))
print(f"the tagged frame takes {ratio:.1f} times as long")
assert untagged != tagged and abs(tagged - untagged) >= 3, (untagged, tagged)
assert ratio > 1.5, ratio
PROGRAM
