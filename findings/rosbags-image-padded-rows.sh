#!/usr/bin/env bash
# rosbags-image 0.10.4, `message_to_cvimage` of an image message with padded rows: it never reads `step`, which
# sensor_msgs/Image defines as "Full row length in bytes", and takes every row to be width * bytes per pixel long.
# Cameras and decoders that align their rows to 32 or 64 bytes, and views cut from wider pictures, send such messages.
# Expected: the picture, as numpy reads it with `step` for its row stride. Seen: another picture without a
# warning. Each row is shifted by the padding of all rows before it, the last rows are lost, and 97 to 98 % of the
# values are wrong.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet rosbags==0.11.9 rosbags-image==0.10.4 numpy==2.4.6 opencv-python-headless==5.0.0.93
"$work/venv/bin/python" - <<'PROGRAM'
import numpy as np
from rosbags.image import message_to_cvimage
from rosbags.typesys import Stores, get_typestore

HEIGHT, WIDTH = 60, 90
store = get_typestore(Stores.ROS2_HUMBLE)
Image = store.types["sensor_msgs/msg/Image"]
Header, Time = store.types["std_msgs/msg/Header"], store.types["builtin_interfaces/msg/Time"]
rows, columns = np.mgrid[:HEIGHT, :WIDTH]

for encoding, dtype, channels in (("mono8", np.uint8, 1), ("rgb8", np.uint8, 3), ("mono16", np.uint16, 1)):
    picture = (rows * 3 + columns).astype(dtype)
    picture = picture if channels == 1 else np.stack([picture, picture // 2, 255 - picture], axis=-1)
    packed = picture.view(np.uint8).reshape(HEIGHT, -1)
    for alignment in (1, 64):
        step = -(-packed.shape[1] // alignment) * alignment
        data = np.zeros((HEIGHT, step), np.uint8)
        data[:, : packed.shape[1]] = packed
        message = Image(Header(Time(0, 0), "camera"), HEIGHT, WIDTH, encoding, 0, step, data.ravel())
        message = store.deserialize_cdr(store.serialize_cdr(message, message.__msgtype__), message.__msgtype__)

        bytes_read = np.ndarray((HEIGHT, packed.shape[1]), np.uint8, message.data, strides=(message.step, 1))
        by_step = np.ascontiguousarray(bytes_read).view(dtype).reshape(picture.shape)
        seen = message_to_cvimage(message)
        wrong = 100 * np.mean(seen != picture)
        print(f"{encoding}, rows of {step} bytes, {packed.shape[1]} of them pixels: {wrong:.0f} % of values are wrong; "
              f"read with `step`, {100 * np.mean(by_step != picture):.0f} %")
        assert np.array_equal(by_step, picture) and seen.shape == picture.shape
        assert wrong == 0 if alignment == 1 else wrong > 80
PROGRAM
