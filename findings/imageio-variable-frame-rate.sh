#!/usr/bin/env bash
# imageio 2.38.1 with imageio-ffmpeg 0.8.1 (its usual reader of videos): a video whose frame rate varies,
# as phones record in the dark, is brought to a constant rate by repeating frames, while `fps` of its
# metadata is the mean rate of the frames in the file. A frame's number over `fps` is no time.
# Expected of 60 frames at 30 and 60 at 15 frames per second, 6.0 s: 120 frames, the number that
# count_frames() gives and the reader of PyAV finds.
# Seen: 179 frames at "20.11 fps", that is 8.9 s: frame 60, which was taken after 2.0 s, is at 2.98 s, and
# 59 frames are copies, which have no baseline to the one before them.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet imageio==2.38.1 imageio-ffmpeg==0.8.1 av==18.0.0 numpy==2.4.6
cd "$work"
"$work/venv/bin/python" - <<'PROGRAM'
from fractions import Fraction
import av
import imageio.v2
import numpy as np

TICK = Fraction(1, 90000)
ticks = np.cumsum([0] + [3000] * 60 + [6000] * 59)  # 30 frames per second, then 15

def picture(number):
    """Picture that shows its number in stripes, one a bit."""
    stripes = 255 * np.unpackbits(np.array([number], np.uint8))
    return np.broadcast_to(np.repeat(stripes, 16)[None, :, None], (64, 128, 3)).astype(np.uint8)

def number_in(picture):
    return int(np.packbits(picture[32, 8::16, 0] > 127)[0])

with av.open("walk.mp4", "w") as made:
    stream = made.add_stream("libx264", rate=30, options={"bf": "0"})
    stream.width, stream.height, stream.pix_fmt = 128, 64, "yuv420p"
    stream.time_base = stream.codec_context.time_base = TICK
    for number, tick in enumerate(ticks):
        frame = av.VideoFrame.from_ndarray(picture(number))
        frame.pts, frame.time_base = int(tick), TICK
        made.mux(stream.encode(frame))
    made.mux(stream.encode())

with av.open("walk.mp4") as video:
    frames = {number_in(one.to_ndarray(format="rgb24")): one.time for one in video.decode(video=0)}
assert list(frames) == list(range(120)) and np.allclose(list(frames.values()), ticks / 90000)

reader = imageio.v2.get_reader("walk.mp4")
fps, counted = reader.get_meta_data()["fps"], reader.count_frames()
seen = [number_in(one) for one in reader]
copies, at = int((np.diff(seen) == 0).sum()), seen.index(60)
print(f"{len(frames)} frames, the last one at {frames[119]:.2f} s; imageio counts {counted} and reads "
      f"{len(seen)} at {fps} fps, {copies} of them copies of the one before; frame 60 of the file is "
      f"number {at}, at {at / fps:.2f} s by fps and {frames[60]:.2f} s by its timestamp")
assert sorted(set(seen)) == list(range(120)), seen
assert counted == 120 and abs(fps - 20.11) < 0.01, (counted, fps)
assert len(seen) == 179 and copies == 59 and at / fps > 2.9, (len(seen), copies, at)
PROGRAM
