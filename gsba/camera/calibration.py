"""What is known of a raw pair's lenses, in files.

Takes JSON of our own form: `rig_T_lens` in metres, unless `unit` is "map". The rig keeps its axes,
and is laid into the middle between the lenses.
"""

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gsba.camera.fisheye import Pair, rotation_of
from gsba.geometry import pose
from gsba.log import GsbaError
from gsba.types import Fisheye

_MODEL = "kannala-brandt: r = f (th + k1 th^3 + k2 th^5 + k3 th^7 + k4 th^9), corner origin"
_ASIDE = np.deg2rad(20.0)  # at most, of a lens's axis from that of the rig


def read_calibration(path: Path) -> Pair:
    """The two lenses that a file describes.

    Raises:
        GsbaError: unreadable, or not of two lenses back to back.
    """
    try:
        tree = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise GsbaError(f"{path}: cannot be read ({error.strerror})") from None
    except ValueError as error:
        raise GsbaError(f"{path}: is not JSON ({error})") from None
    try:
        metric = tree.get("unit", "m") == "m"
        front, back = (_lens(tree["lenses"][name], metric) for name in ("front", "back"))
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise GsbaError(
            f"{path}: not a calibration of two lenses ({type(error).__name__}: {error}); it holds "
            "lenses.front and lenses.back, each with width, height, f, cx, cy, k and rig_T_lens"
        ) from None
    try:
        return _centred((front, back))
    except ValueError as error:
        raise GsbaError(f"{path}: {error}") from None


def calibration_json(
    pair: Pair, centre: np.ndarray, unit: str, more: Mapping[str, Any]
) -> dict[str, Any]:
    """The content of a calibration file.

    Args:
        pair: the lenses.
        centre: (3,) of the front one in the rig; the other one is as far behind.
        unit: of that, "m" or "map".
        more: what else is known.
    """
    return {
        "model": _MODEL,
        "unit": unit,
        "lenses": {
            name: {
                "width": lens.width,
                "height": lens.height,
                "f": lens.focal,
                "cx": lens.principal[0],
                "cy": lens.principal[1],
                "k": list(lens.radial),
                "rig_T_lens": pose(rotation_of(lens), sign * centre).tolist(),
            }
            for name, lens, sign in zip(("front", "back"), pair, (1, -1), strict=True)
        },
        **more,
    }


def _centred(pair: Pair) -> Pair:
    """The same lenses in a rig between them.

    Raises:
        ValueError: they do not look ahead and behind.
    """
    ways = [rotation_of(lens)[2, 2] for lens in pair]
    if min(ways[0], -ways[1]) < np.cos(_ASIDE):
        raise ValueError(
            "the front lens is to look along z of the rig and the back one the other way, within "
            f"{np.rad2deg(_ASIDE):.0f} degrees"
        )
    middle = (np.asarray(pair[0].centre) + pair[1].centre) / 2
    front, back = (replace(lens, centre=_three(np.asarray(lens.centre) - middle)) for lens in pair)
    return front, back


def fitted(pair: Pair, size: tuple[int, int], path: Path) -> Pair:
    """A calibration for pictures of another size.

    Raises:
        GsbaError: of another shape.
    """
    width, height = size
    for lens in pair:
        if abs(width * lens.height - height * lens.width) > 0.01 * width * lens.height:
            raise GsbaError(
                f"{path}: is of pictures of {lens.width}x{lens.height}, but these are "
                f"{width}x{height}: of another shape; give the calibration of this mode"
            )
    front, back = (
        replace(
            lens,
            width=width,
            height=height,
            focal=lens.focal * width / lens.width,
            principal=(
                lens.principal[0] * width / lens.width,
                lens.principal[1] * height / lens.height,
            ),
        )
        for lens in pair
    )
    return front, back


def _lens(tree: Mapping[str, Any], metric: bool) -> Fisheye:
    from scipy.spatial.transform import Rotation

    rig_T_lens = np.array(tree["rig_T_lens"], dtype=np.float64).reshape(4, 4)
    turn = rig_T_lens[:3, :3]
    if not np.isfinite(rig_T_lens).all() or np.abs(turn @ turn.T - np.eye(3)).max() > 1e-3:
        raise ValueError("rig_T_lens is no rigid motion")
    if np.linalg.det(turn) < 0:
        raise ValueError("rig_T_lens mirrors")
    terms = [float(k) for k in tree["k"]]
    k1, k2, k3, k4 = [*terms, 0.0, 0.0, 0.0, 0.0][:4]
    width = int(tree.get("width") or tree["size"])
    height = int(tree.get("height") or tree["size"])
    lens = Fisheye(
        width,
        height,
        float(tree["f"]),
        (float(tree["cx"]), float(tree["cy"])),
        (k1, k2, k3, k4),
        _three(Rotation.from_matrix(turn).as_rotvec()),
        _three(rig_T_lens[:3, 3] if metric else np.zeros(3)),
    )
    numbers = [lens.focal, *lens.principal, *terms]
    if len(terms) > 4 or not np.isfinite(numbers).all() or min(lens.focal, width, height) <= 0:
        raise ValueError("f, cx, cy, up to four k and the size are to be numbers, f above 0")
    return lens


def _three(vector: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in vector)
    return x, y, z
