"""Walk with a 360-degree camera through the gallery: frames, exact truth, SLAM-like poses."""

import logging
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from scipy.ndimage import gaussian_filter1d

from gsba.camera.sphere import erp_directions
from gsba.compilation import compile_ahead
from gsba.demo.degrade import degrade
from gsba.demo.two_lenses import TwoLenses
from gsba.disk import disk_errors, write_csv
from gsba.geometry import pose, unit
from gsba.log import GsbaError, track
from gsba.trajectory.files import write_tum
from gsba.types import Trajectory

WalkPath = Literal["rectangle", "oval", "open"]
Heading = Literal["locked", "forward"]
Camera = Literal["ideal", "two-lens"]

FRAMES_PER_SECOND = 2.0
NOISE = 2.0  # grey values, standard deviation
JPEG_QUALITY = 95
MOST_FRAMES, MOST_WIDTH = 100_000, 16_384

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class DemoWalk:
    """Files of a walk."""

    frames_dir: Path  # NNNNNN.jpg and timestamps.csv
    truth_path: Path  # TUM, exact poses, world of the gallery
    slam_path: Path  # TUM, poses with drift, world of the first frame and another scale
    lenses: TwoLenses | None  # true camera; None = one centre and a global shutter


def make_walk(
    out: Path,
    path: WalkPath = "rectangle",
    heading: Heading = "locked",
    num_frames: int = 40,
    width: int = 1024,
    seed: int = 0,
    depth: bool = False,
    camera: Camera = "ideal",
) -> DemoWalk:
    """Render a walk into the folder `out`; an earlier walk there is replaced.

    Args:
        path: "rectangle" and "oval" end one step before their start, "open" does not return.
        heading: "locked" keeps one direction, "forward" follows the path.
        num_frames: at least 3.
        width: width of the equirectangular frames in pixels, an even number of at least 64.
        seed: seed of the hand's wobble, the noise and the drift.
        depth: also write depth/NNNNNN.npz with `range`, (width / 8, width / 4) float32: distance
            along the ray through each pixel of that size, 0 = no surface.
        camera: "ideal" has one centre and a global shutter, "two-lens" has two lenses with a
            rolling shutter (`TwoLenses`; also writes calibration.json). True poses are those in
            the middle of the readout, midway between the lenses.

    Raises:
        GsbaError: an argument is out of range, or `out` is not a walk's folder.
    """
    from gsba.demo.gallery import build_gallery

    check_choices(path, heading, camera)
    check_walk(out, num_frames, width, seed)
    lenses = TwoLenses() if camera == "two-lens" else None
    truth = walk_poses(path, heading, num_frames, seed)
    scene = build_gallery()
    logger.info("gallery of %d faces, %d frames of %d px", len(scene.corners), num_frames, width)
    with walk_folder(out, truth, seed) as partial:
        write_frames(partial, truth, render_walk(scene, truth, width, seed, lenses), seed)
        if lenses is not None:
            lenses.write(partial / "calibration.json")
        if depth:
            write_depth(partial / "depth", scene, truth, width // 4)
    return DemoWalk(out / "images", out / "groundtruth.tum", out / "slam.tum", lenses)


@contextmanager
def walk_folder(out: Path, truth: Trajectory, seed: int) -> Iterator[Path]:
    """Folder to write a walk's images into; adds its trajectories and replaces `out` at the end."""
    compile_ahead("demo", "refine")  # walks are made to be refined
    with replaced_folder(out) as partial:
        (partial / "images").mkdir()
        yield partial
        write_tum(partial / "groundtruth.tum", truth)
        write_tum(partial / "slam.tum", degrade(truth, seed))


@contextmanager
def replaced_folder(out: Path) -> Iterator[Path]:
    """Empty folder to write into; it replaces `out` at the end, unless an exception is raised."""
    partial = out.with_name(f".{out.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    yield partial
    if out.exists():
        shutil.rmtree(out)
    partial.rename(out)


def walk_poses(
    path: WalkPath, heading: Heading, num_frames: int, seed: int, fps: float = FRAMES_PER_SECOND
) -> Trajectory:
    """Exact poses of a walk, evenly spaced along its path, with a hand's wobble.

    World: x right, y down, z forward, floor at y = 0, in the gallery's units.
    """
    rng = np.random.default_rng(seed)
    at, tangent = _sample(path, num_frames)
    yaw = np.arctan2(tangent[:, 0], tangent[:, 1]) if heading == "forward" else 0.0
    positions = np.stack([at[:, 0], np.full(num_frames, -1.5), at[:, 1]], axis=1)
    return held_by_hand(positions, yaw, rng, fps=fps)


def held_by_hand(
    positions: np.ndarray,
    yaw: np.ndarray | float,
    rng: np.random.Generator,
    unit: float = 1.0,
    fps: float = FRAMES_PER_SECOND,
) -> Trajectory:
    """Poses at positions (N, 3) and headings of a walk, with a hand's wobble.

    Args:
        positions: (N, 3) positions.
        yaw: headings (N,), or one heading, radians.
        unit: unit of the positions, in units of the gallery.
        fps: poses per second; the wobble's frequency in Hz does not depend on it.
    """
    times = np.arange(len(positions)) / fps
    wobble = [_wobble(rng, times) for _ in range(6)]
    # standard deviations of the hand's pitch, yaw and roll, degrees
    pitch, turn, roll = (np.radians(w) * x for w, x in zip((1.5, 2.0, 1.5), wobble, strict=False))
    rotations = _rotations(1, yaw + turn) @ _rotations(0, pitch) @ _rotations(2, roll)
    swaying = positions + unit * 0.025 * np.stack(wobble[3:], axis=1)
    return Trajectory(times, pose(rotations, swaying))


def _sample(path: WalkPath, num_frames: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions and unit tangents (x, z), each (num_frames, 2), evenly spaced on the path."""
    closed = path != "open"
    if path == "oval":
        angle = np.linspace(0, 2 * np.pi, 73)
        corners = np.stack([-4.5 * np.cos(angle), -3.0 * np.sin(angle)], axis=1)
    elif path == "rectangle":
        corners = np.array(
            [[-4.4, 0], [-4.4, -2.6], [4.4, -2.6], [4.4, 2.6], [-4.4, 2.6], [-4.4, 0]]
        )
    else:  # through the passage
        corners = np.array(
            [[-4.4, 2.6], [-4.4, -2.6], [0, -2.6], [0, 2.8], [4.4, 2.8], [4.4, -2.6]]
        )
    spacing = 0.01
    length = _arc_length(corners)
    s = np.arange(0, length[-1], spacing)
    dense = np.stack([np.interp(s, length, corners[:, k]) for k in range(2)], axis=1)
    mode = "wrap" if closed else "nearest"
    dense = gaussian_filter1d(dense, 0.45 / spacing, axis=0, mode=mode)  # rounds corners
    if closed:
        dense = np.concatenate([dense, dense[:1]])
    length = _arc_length(dense)
    stops = np.linspace(0, length[-1], num_frames, endpoint=not closed)
    tangent = np.gradient(dense, axis=0)
    at, along = (
        np.stack([np.interp(stops, length, x[:, k]) for k in range(2)], axis=1)
        for x in (dense, tangent)
    )
    return at, unit(along)


def _arc_length(points: np.ndarray) -> np.ndarray:
    """Length (N,) of a polyline (N, D) up to each of its points."""
    return np.r_[0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))]


def _wobble(rng: np.random.Generator, times: np.ndarray) -> np.ndarray:
    """Irregular oscillation (N,) of unit variance at times (N,), seconds, periods of 2 to 7 s."""
    phase = rng.uniform(0, 2 * np.pi, (3, 1))
    frequency = 2 * np.pi / rng.uniform(4, 14, (3, 1))
    steps = FRAMES_PER_SECOND * times
    return np.sin(frequency * steps + phase).sum(axis=0) * np.sqrt(2 / 3)


def _rotations(axis: int, angles: np.ndarray | float) -> np.ndarray:
    """Rotations (N, 3, 3) about one axis."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(np.atleast_1d(angles)[:, None] * np.eye(3)[axis]).as_matrix()


def write_frames(out: Path, truth: Trajectory, pictures: Iterator[np.ndarray], seed: int) -> None:
    """Write panoramas (H, W, 3), 0..255, as JPEGs with exposure and noise, and their times."""
    import cv2

    names = [f"{f:06d}.jpg" for f in range(len(truth.timestamps))]
    for name, bgr in zip(names, exposed(truth, pictures, seed), strict=True):
        quality = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
        if not cv2.imwrite(str(out / "images" / name), bgr, quality):
            raise GsbaError(
                f"{out / 'images' / name} cannot be written: check that the disk is not full"
            )
    rows = ((name, f"{t:.6f}") for name, t in zip(names, truth.timestamps, strict=True))
    write_csv(out / "images" / "timestamps.csv", ["name", "timestamp"], rows)


def exposed(truth: Trajectory, pictures: Iterator[np.ndarray], seed: int) -> Iterator[np.ndarray]:
    """Images (H, W, 3) uint8 BGR with a sensor's exposure and noise, from RGB, 0..255."""
    rng = np.random.default_rng([seed, 1])
    exposures = 1 + 0.05 * np.tanh(_wobble(rng, truth.timestamps - truth.timestamps[0]))
    frames = zip(pictures, exposures, strict=True)
    for picture, exposure in track(frames, "rendering the walk", total=len(exposures)):
        image = exposure * picture
        image += NOISE * rng.standard_normal(image.shape, dtype=np.float32)
        yield np.clip(image[..., ::-1] + 0.5, 0, 255).astype(np.uint8)


def render_walk(
    scene, truth: Trajectory, width: int, seed: int, lenses: TwoLenses | None
) -> Iterator[np.ndarray]:
    """Yield panoramas (width / 2, width, 3) float32 of the frames."""
    from gsba.demo.render import render_erp
    from gsba.demo.two_lenses import poses_during, render_stitched

    if lenses is None:
        for world_T_rig in truth.world_T_rigs:
            yield render_erp(scene, world_T_rig, width, width // 2)
        return
    for world_T_rigs in poses_during(truth, lenses.readout_s, seed):
        yield render_stitched(scene, world_T_rigs, lenses, width, width // 2)


def write_depth(folder: Path, scene, truth: Trajectory, width: int) -> None:
    """Write distances (width / 2, width) float32 along the rays of panoramas, 0 = none hit."""
    from gsba.demo.raycast import ranges

    folder.mkdir()
    bearings = erp_directions(width).reshape(-1, 3)
    for f, world_T_rig in enumerate(truth.world_T_rigs):
        hit = ranges(scene, world_T_rig[:3, 3], bearings @ world_T_rig[:3, :3].T)
        depth = hit.reshape(width // 2, width).astype(np.float32)
        np.savez_compressed(folder / f"{f:06d}.npz", range=depth)


def check_choices(path: str, heading: str, camera: str) -> None:
    """Raise GsbaError for an unknown path, heading or camera."""
    choices = ((path, WalkPath, "path"), (heading, Heading, "heading"), (camera, Camera, "camera"))
    for value, allowed, what in choices:
        if value not in get_args(allowed):
            raise GsbaError(f"{what} {value!r} is none of {', '.join(get_args(allowed))}")


def check_walk(out: Path, num_frames: int, width: int, seed: int) -> None:
    """Raise GsbaError for numbers out of range, and for a folder that is not a walk's."""
    if seed < 0:
        raise GsbaError(f"seed {seed}: must be 0 or more")
    if not 3 <= num_frames <= MOST_FRAMES:
        raise GsbaError(f"a walk of {num_frames} frames: 3 to {MOST_FRAMES} can be rendered")
    if not 64 <= width <= MOST_WIDTH or width % 2:
        raise GsbaError(f"frames {width} px wide: an even number of 64 to {MOST_WIDTH} is needed")
    if out.exists() and not (out / "groundtruth.tum").is_file() and any(out.iterdir()):
        raise GsbaError(f"{out} is not empty and not a walk's folder: choose another --out")


FPS = 8  # frames per second
WHOLE_WALK = 240  # frames of a whole path: steps of about 0.11 units in a room of 14 by 10 units
_CODECS = (("libx264", {"crf": "14", "preset": "veryfast", "threads": "1"}), ("mpeg4", {"q": "2"}))


@dataclass(frozen=True, slots=True)
class DemoFilm:
    """Files of a filmed walk."""

    video_path: Path  # MP4, 2:1 panoramas
    truth_path: Path  # TUM, exact poses of its frames, world of the gallery
    lenses: TwoLenses | None  # true camera; None = one centre and a global shutter


def make_film(
    out: Path,
    path: WalkPath = "rectangle",
    heading: Heading = "locked",
    num_frames: int = WHOLE_WALK,
    width: int = 720,
    seed: int = 0,
    camera: Camera = "ideal",
) -> DemoFilm:
    """Film a walk into `out`/walk.mp4; an earlier walk in `out` is replaced.

    Args:
        num_frames: at least 3; with fewer than WHOLE_WALK the walk covers a part of the path.
        path, heading, width, seed, camera: see `gsba.demo.make_walk`.

    Returns:
        The files of the video and of its truth, with times from 0 in steps of 1 / FPS seconds.

    Raises:
        GsbaError: an argument is out of range, `out` is not a walk's folder, or PyAV is missing.
    """
    from gsba.demo.gallery import build_gallery

    check_choices(path, heading, camera)
    check_walk(out, num_frames, width, seed)
    try:
        import av
    except ImportError:
        raise GsbaError("--video needs PyAV to write a video: pip install 'gsba[video]'") from None
    lenses = TwoLenses() if camera == "two-lens" else None
    whole = walk_poses(path, heading, max(num_frames, WHOLE_WALK), seed, FPS)
    truth = Trajectory(whole.timestamps[:num_frames], whole.world_T_rigs[:num_frames])
    scene = build_gallery()
    logger.info("gallery of %d faces, %d frames of %d px", len(scene.corners), num_frames, width)
    compile_ahead("demo", "odometry", "refine")  # films are made to be refined
    with replaced_folder(out) as partial:
        pictures = render_walk(scene, truth, width, seed, lenses)
        _encode(av, partial / "walk.mp4", exposed(truth, pictures, seed), width)
        write_tum(partial / "groundtruth.tum", truth)
    return DemoFilm(out / "walk.mp4", out / "groundtruth.tum", lenses)


def _encode(av: Any, path: Path, pictures: Iterator[np.ndarray], width: int) -> None:
    """Write images (width / 2, width, 3) uint8 BGR as a video, H.264 if PyAV can encode it."""
    codec, options = next(c for c in _CODECS if c[0] in av.codecs_available)
    with disk_errors(path), av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=Fraction(FPS), options=options)
        stream.width, stream.height, stream.pix_fmt = width, width // 2, "yuv420p"
        for picture in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="bgr24")))
        container.mux(stream.encode())
