"""Shifts of texture by what a camera does to pixels: along the optical flow and across it.

    python benchmarks/filmed_shifts.py [--seed 0] [--frames 3 8 13 18] [--effects all ideal ...]

Frames of the gallery are filmed by the camera of `filmed_camera.py` from one centre at one instant,
so that a picture without any effect shows each point where it is. 1500 corners of that picture are
found again in the filmed one by Lucas-Kanade (11 x 11 pixels, of pictures of normalised contrast).
Shifts along the flow of 1/30 s show a lag, their spread the noise of patches, and the correlation
of neighbours' shifts how far patches err alike. Effects are named as for `filmed.py`; those with a
codec are measured before it, too, with a quantiser of 37 (32 if the codec is the only effect).
"""

import argparse
import tempfile
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from filmed import WIDTH, asked, scene_of
from filmed_camera import BURST, VIDEO_FPS, Camera, Hands, _decode, _encode
from scipy.spatial import KDTree

from gsba.demo.render import EXPOSURE
from gsba.types import Trajectory

# Rows, lenses, blur and people change where things are; exposure wanders along whole walks.
LEFT_OUT = frozenset({"lenses", "rows", "blur", "people", "wander", "stabilised"})
CORNERS, WINDOW_PX, SEAM_DEG = 1500, 11, 6.0
MOST_PX = 2.0  # of a shift: others are found at another place
LEAST_FLOW_PX = 0.5
RINGS_PX = ((0, 8), (8, 16), (16, 32), (32, 64))  # distances of neighbours


class Clean:
    """Corners of pictures without any effect, and their optical flow."""

    def __init__(self, camera: Camera) -> None:
        self.references, self.corners, self.flows, self.contrasts = [], [], [], []
        ahead = np.abs(camera.bearings[..., 2]) > np.sin(np.radians(SEAM_DEG))
        open_ = ahead.astype(np.uint8) * 255
        open_[: WIDTH // 12] = open_[-(WIDTH // 12) :] = 0
        open_[:, :WINDOW_PX] = open_[:, -WINDOW_PX:] = 0
        for time in camera.hands.walk.timestamps:
            now, before = (_rendered(camera, at) for at in (time, time - 1 / VIDEO_FPS))
            found = cv2.goodFeaturesToTrack(now, CORNERS, 0.003, 5, mask=open_)
            back, ok = _tracked(now.astype(np.uint8), before.astype(np.uint8), found, 3)
            detail = (now - cv2.GaussianBlur(now, (0, 0), 4)) ** 2
            contrast = np.sqrt(cv2.GaussianBlur(detail, (0, 0), 3))
            column, row = found[ok, 0].astype(int).T
            self.references.append(_normalised(now))
            self.corners.append(found[ok])
            self.flows.append(-back[ok])
            self.contrasts.append(contrast[row, column])


def _rendered(camera: Camera, time: float) -> np.ndarray:
    """Grey picture (H, W) float32 of the scene at one instant."""
    ideal = Camera(camera.scene, camera.hands, frozenset(), WIDTH, camera.seed)
    views = [ideal.record(time, side, 0, 1).radiance for side in (1.0, -1.0)]
    front, back = (255 * (1 - np.exp(-EXPOSURE * np.maximum(view, 0))) for view in views)
    return _grey(np.where(camera.bearings[..., 2:] > 0, front, back))


def _grey(picture: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(np.clip(picture, 0, 255).astype(np.float32), cv2.COLOR_RGB2GRAY)


def _normalised(grey: np.ndarray) -> np.ndarray:
    """Detail over its local contrast, uint8."""
    detail = grey - cv2.GaussianBlur(grey, (0, 0), 4)
    contrast = np.sqrt(cv2.GaussianBlur(detail * detail, (0, 0), 6)) + 2
    return np.clip(128 + 40 * detail / contrast, 0, 255).astype(np.uint8)


def _tracked(
    one: np.ndarray, other: np.ndarray, corners: np.ndarray, levels: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Shifts (N, 2) of corners (N, 1, 2) from one picture to another, and if they were found."""
    window = (WINDOW_PX, WINDOW_PX)
    ends = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 40, 0.002)
    given = {"winSize": window, "maxLevel": levels, "criteria": ends}
    found, ok, _ = cv2.calcOpticalFlowPyrLK(one, other, corners, None, **given)  # type: ignore
    return (found - corners)[:, 0], ok.ravel() > 0


def row_of(clean: Clean, pictures: list[np.ndarray]) -> str:
    """Cells of a table: lag and spreads in pixels, lag by thirds of contrast, correlations."""
    along, across, contrasts = [], [], []
    products: dict[int, list[float]] = {low: [] for low, _ in RINGS_PX}
    for f, picture in enumerate(pictures):
        corners, flow = clean.corners[f], clean.flows[f]
        shift, ok = _tracked(clean.references[f], _normalised(_grey(picture)), corners)
        speed = np.linalg.norm(flow, axis=1)
        ok &= (np.linalg.norm(shift, axis=1) < MOST_PX) & (speed > LEAST_FLOW_PX)
        unit = flow[ok] / speed[ok, None]
        both = np.column_stack(
            [
                np.sum(shift[ok] * unit, axis=1),
                shift[ok, 1] * unit[:, 0] - shift[ok, 0] * unit[:, 1],
            ]
        )
        along.append(both[:, 0])
        across.append(both[:, 1])
        contrasts.append(clean.contrasts[f][ok])
        off = np.clip(both - np.median(both, axis=0), -0.6, 0.6)
        places = corners[ok, 0]
        tree = KDTree(places)
        for low, high in RINGS_PX:
            one, other = tree.query_pairs(high, output_type="ndarray").T
            ring = np.linalg.norm(places[one] - places[other], axis=1) > low
            mean = float(np.mean(off[one[ring]] * off[other[ring]]))
            products[low].append(mean / float(off.var()))
    lags, contrast = np.concatenate(along), np.concatenate(contrasts)
    limits = np.quantile(contrast, [0, 1 / 3, 2 / 3, 1])
    thirds = [
        np.median(lags[(contrast >= low) & (contrast <= high)]) for low, high in pairwise(limits)
    ]
    cells = [
        f"{np.median(lags):+.3f}",
        f"{_spread(lags):.3f}",
        f"{_spread(np.concatenate(across)):.3f}",
        ", ".join(f"{third:+.3f}" for third in thirds),
        ", ".join(f"{np.median(one):+.3f}" for one in along),
        ", ".join(f"{np.mean(of_ring):.2f}" for of_ring in products.values()),
    ]
    return " | ".join(cells)


def _spread(values: np.ndarray) -> float:
    return float(1.4826 * np.median(np.abs(values - np.median(values))))


def main() -> None:
    """Film the frames with each set of effects, and print their shifts."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--frames", nargs="+", type=int, default=[3, 8, 13, 18])
    parser.add_argument("--effects", nargs="+", default=["ideal", "all"])
    options = parser.parse_args()
    built, walk = scene_of("gallery", options.seed)
    hands = Hands(walk, options.seed)
    rows = options.frames
    hands.walk = Trajectory(walk.timestamps[rows], walk.world_T_rigs[rows])
    clean = Clean(Camera(built, hands, frozenset(), WIDTH, options.seed))
    speeds = [float(np.median(np.linalg.norm(flow, axis=1))) for flow in clean.flows]
    print("flow, pixels in 1/30 s:", ", ".join(f"{speed:.1f}" for speed in speeds), flush=True)
    for name, effects in asked(options.effects).items():
        camera = Camera(built, hands, effects - LEFT_OUT, WIDTH, options.seed)
        bursts = list(camera.frames())
        codec = camera.effects & {"hevc", "hevc10"}
        title = f"{name}, before the codec" if codec else name
        print(f"| {title} | {row_of(clean, [burst[-1] for burst in bursts])} |", flush=True)
        if codec:
            quantiser = 32 if camera.effects == codec else 37
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / "film.mp4"
                _encode(bursts, quantiser, "hevc10" in codec, path)
                pictures = _decode(path, BURST)
            print(f"| {name} | {row_of(clean, pictures)} |", flush=True)


if __name__ == "__main__":
    main()
