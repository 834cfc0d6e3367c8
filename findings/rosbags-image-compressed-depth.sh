#!/usr/bin/env bash
# rosbags-image 0.10.4, `message_to_cvimage` of a compressed image of 16 bits, such as depth in millimetres that
# image_transport sends as "16UC1; png compressed": it decodes without OpenCV's IMREAD_ANYDEPTH, which converts
# to 8 bits. The same picture in an uncompressed message keeps its 16 bits.
# Expected: the depths that were compressed, as OpenCV decodes them with IMREAD_UNCHANGED (PNG is lossless).
# Seen: bytes, each the depth divided by 256 and rounded down: 2.000 m and 2.040 m are both 7, nothing warns.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet rosbags==0.11.9 rosbags-image==0.10.4 numpy==2.4.6 opencv-python-headless==5.0.0.93
"$work/venv/bin/python" - <<'PROGRAM'
import cv2
import numpy as np
from rosbags.image import message_to_cvimage
from rosbags.typesys import Stores, get_typestore

store = get_typestore(Stores.ROS2_HUMBLE)
Compressed, Image = (store.types[f"sensor_msgs/msg/{name}"] for name in ("CompressedImage", "Image"))
Header, Time = store.types["std_msgs/msg/Header"], store.types["builtin_interfaces/msg/Time"]
header = Header(Time(0, 0), "camera")

depth = np.linspace(500, 9000, 80 * 100).round().astype(np.uint16).reshape(80, 100)  # millimetres
_, png = cv2.imencode(".png", depth)
compressed = message_to_cvimage(Compressed(header, "16UC1; png compressed", png.ravel()))
raw = message_to_cvimage(Image(header, 80, 100, "16UC1", 0, 200, depth.view(np.uint8).ravel()))
unchanged = cv2.imdecode(png, cv2.IMREAD_UNCHANGED)

for name, seen in (("uncompressed", raw), ("PNG by OpenCV", unchanged), ("PNG by rosbags-image", compressed)):
    print(f"{name}: {seen.dtype}, {seen.min()} to {seen.max()}, {len(np.unique(seen))} different values")
assert np.array_equal(raw, depth) and np.array_equal(unchanged, depth)
assert compressed.dtype == np.uint8
assert np.array_equal(compressed, depth // 256), np.abs(compressed - depth / 256.0).max()
PROGRAM
