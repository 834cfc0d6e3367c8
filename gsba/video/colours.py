"""Grey values and sRGB colours of decoded frames, converted from what their file says they hold.

HDR is converted by display-referred reference white: diffuse white, 75 % of an HLG signal or
203 cd/m2 of a PQ one (ITU-R BT.2408-7, table 1), becomes white of sRGB, and brighter pixels clip.
Curves are those of ITU-R BT.2100-2, tables 4 and 5; primaries are converted by BT.2087-0.
"""

import functools
from typing import Any

import cv2
import numpy as np

_FULL_RANGE = np.clip(np.rint((np.arange(256) - 16) * 255 / 219), 0, 255).astype(np.uint8)  # grey
# values of a limited-range luma
_PQ, _HLG = 16, 18  # transfer characteristics of ITU-T H.273, table 3
_LEVELS = 1 << 12  # of the tables below: 16 bits are cut to 12
_BT709_BY_BT2020 = np.array(
    [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]],
    np.float32,
)


def luma(frame: Any) -> np.ndarray:
    """Brightness (H, W) uint8 of an av.VideoFrame, over the full range from black 0 to white 255.

    YUV frames give their luma plane, whatever their colour matrix: equal matrices on both sides
    save FFmpeg the way over RGB. Limited range (16 to 235) is stretched; untagged frames have it.
    HDR frames give the grey value of their sRGB colours.
    """
    from av.video.reformatter import ColorRange, Colorspace

    if hdr_name(frame.color_trc):
        return cv2.cvtColor(bgr(frame), cv2.COLOR_BGR2GRAY)
    kind = frame.format
    options = {"src_colorspace": Colorspace.ITU601, "dst_colorspace": Colorspace.ITU601}
    is_plain = len(kind.components) > 2 and not kind.is_rgb and kind.components[0].bits == 8
    if is_plain:  # FFmpeg copies the plane; the range is applied faster below
        options |= {"src_color_range": ColorRange.JPEG, "dst_color_range": ColorRange.JPEG}
    grey = frame.reformat(format="gray", **options).to_ndarray()
    full_range = frame.color_range == ColorRange.JPEG or kind.name.startswith("yuvj")
    return cv2.LUT(grey, _FULL_RANGE) if is_plain and not full_range else grey


def bgr(frame: Any) -> np.ndarray:
    """Colours (H, W, 3) uint8 BGR of an av.VideoFrame, sRGB; the default matrix is BT.709."""
    from av.video.reformatter import Colorspace

    matrix = Colorspace.ITU709 if int(frame.colorspace) == 2 else None  # AVCOL_SPC_UNSPECIFIED
    # BT.2020 (H.273, table 2)
    transfer, wide = int(frame.color_trc), int(frame.color_primaries) == 9
    if not (hdr_name(transfer) or wide):
        return frame.reformat(format="bgr24", src_colorspace=matrix).to_ndarray()
    signal = frame.reformat(format="rgb48le", src_colorspace=matrix).to_ndarray()
    light = _light_of_signal(transfer)[signal >> 4]
    if wide:
        light = cv2.transform(light, _BT709_BY_BT2020)
    rows = np.clip(np.rint(light * (_LEVELS - 1)), 0, _LEVELS - 1).astype(np.uint16)
    return np.ascontiguousarray(_srgb_of_light()[rows][..., ::-1])


def hdr_name(transfer: int) -> str:
    """Name of an HDR transfer characteristic of H.273; "" = the signal is not HDR."""
    return {_PQ: "PQ", _HLG: "HLG"}.get(int(transfer), "")


@functools.lru_cache(maxsize=4)
def _light_of_signal(transfer: int) -> np.ndarray:
    """Linear light (4096,) float32 of signal levels; 1 = reference white."""
    signal = np.linspace(0, 1, _LEVELS)
    if transfer == _HLG:
        a, b, c = 0.17883277, 0.28466892, 0.55991073
        light = np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - c) / a) + b) / 12)
        white = (np.exp((0.75 - c) / a) + b) / 12
    elif transfer == _PQ:
        m1, m2, c1, c2, c3 = 0.1593017578125, 78.84375, 0.8359375, 18.8515625, 18.6875
        root = signal ** (1 / m2)
        light = (np.maximum(root - c1, 0) / (c2 - c3 * root)) ** (1 / m1)
        white = 203 / 10_000
    else:  # wide primaries with a usual curve: shown like sRGB
        light = np.where(signal <= 0.04045, signal / 12.92, ((signal + 0.055) / 1.055) ** 2.4)
        white = 1.0
    return (light / white).astype(np.float32)


@functools.lru_cache(maxsize=1)
def _srgb_of_light() -> np.ndarray:
    """Grey values (4096,) uint8 of linear light from 0 to 1 (IEC 61966-2-1)."""
    light = np.linspace(0, 1, _LEVELS)
    signal = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.rint(255 * signal).astype(np.uint8)
