"""A small scene with known poses, points and pictures, for the export tests."""

import functools
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
from pixels import pixel_centres
from plain_records import frames_of, map_of, observing
from scipy.spatial.transform import Rotation
from synthetic import unit

from gsba import load_run
from gsba.camera.lens import Lenses
from gsba.camera.rig import RIG_R_FACE
from gsba.camera.sphere import erp_directions
from gsba.disk import encoded_image, write_bytes, write_image
from gsba.export import ExportFormat, export
from gsba.geometry import inverse, pose
from gsba.store.records import save_record
from gsba.types import FACES, FrameSet, PictureFormat, Reconstruction

NUM_FRAMES = 9
TIMES = np.arange(NUM_FRAMES) * 0.5
WIDTH, HEIGHT = 512, 256
BLOB_RAD = 0.025  # spread of a point's picture; a panorama's pixel is 0.012

# One point around each axis, one each behind (on both sides of the seam) and at face edges.
POINTS = np.array(
    [
        [0.3, 0.2, 5.0],
        [5.0, -0.4, 0.5],
        [-0.7, 0.5, -5.0],
        [-5.0, -0.2, 0.6],
        [0.6, -5.0, 0.4],
        [-0.5, 5.0, -0.3],
        [0.1, -1.5, -5.0],
        [3.6, 1.0, 3.5],
        [-3.4, -0.8, 3.6],
    ]
)
COLORS = np.array(
    [[255, 60, 60], [60, 255, 60], [60, 60, 255], [255, 255, 60], [60, 255, 255]] * 2, np.uint8
)[: len(POINTS)]


def save_run(root: Path) -> None:
    """Save the scene as the records of a finished run, in whose folder the rest is."""
    save_record(root / "stages/reconstruction.npz", reconstruction(), {})
    save_record(root / "stages/frames.npz", panoramas(root.parent / "frames"), {})
    load_run(root)  # whose reader takes them


def poses() -> np.ndarray:
    """World_T_rig of the frames: a short walk, turning a little; frame 0 is the world itself."""
    rng = np.random.default_rng(0)
    rotations = Rotation.from_rotvec(rng.normal(0, 0.08, (NUM_FRAMES, 3))).as_matrix()
    positions = rng.normal(0, 0.2, (NUM_FRAMES, 3))
    world_T_rigs = pose(rotations, positions)
    world_T_rigs[0] = np.eye(4)
    return world_T_rigs


def bearings(world_T_rigs: np.ndarray) -> np.ndarray:
    """Bearings (F, J, 3) of POINTS in each rig frame."""
    homogeneous = np.column_stack([POINTS, np.ones(len(POINTS))])
    local = np.einsum("fij,pj->fpi", inverse(world_T_rigs)[:, :3], homogeneous)
    return local / np.linalg.norm(local, axis=-1, keepdims=True)


def reconstruction() -> Reconstruction:
    """Every point seen in every frame, without error."""
    world_T_rigs = poses()
    seen = np.swapaxes(bearings(world_T_rigs), 0, 1).reshape(-1, 3)  # by point, then frame
    owners, frames = np.divmod(np.arange(len(seen)), NUM_FRAMES)
    own = {"point_colors": COLORS, "point_errors": np.linspace(0, 0.01, len(POINTS))}
    return map_of(world_T_rigs, POINTS, owners, frames, seen, **own)


def picture(directions: np.ndarray, point_bearings: np.ndarray) -> np.ndarray:
    """Image (..., 3) uint8 with a soft blob of each point's colour, along directions (..., 3)."""
    image = np.full((*directions.shape[:-1], 3), 30.0)
    for bearing, color in zip(point_bearings, COLORS, strict=True):
        near = directions @ bearing > 1 - 32 * BLOB_RAD**2  # within eight times the spread
        chord = np.linalg.norm(directions[near] - bearing, axis=-1, keepdims=True)
        weight = np.exp(-0.5 * np.square(chord / BLOB_RAD))
        image[near] = image[near] * (1 - weight) + color * weight
    return np.round(image).astype(np.uint8)


def _encoded(shown: np.ndarray, suffix: str) -> list[bytes]:
    """Files of panoramas that show POINTS in directions (F, J, 3)."""
    directions = erp_directions(WIDTH)
    return [encoded_image(picture(directions, seen), Path(f"a{suffix}")) for seen in shown]


@functools.cache
def _of_one_centre(suffix: str) -> list[bytes]:
    return _encoded(bearings(poses()), suffix)


def shown_by(lenses: Lenses) -> np.ndarray:
    """Directions (F, J, 3) in which panoramas of two lenses show POINTS."""
    local = (POINTS - poses()[:, None, :3, 3]) @ poses()[:, :3, :3]
    frames = np.repeat(np.arange(NUM_FRAMES), len(POINTS))
    shown = lenses.seeing(local.reshape(-1, 3), frames).reshape(local.shape)
    return shown / np.linalg.norm(shown, axis=-1, keepdims=True)


def seen_by_lenses(lenses: Lenses, band_rad: float | None = None) -> Reconstruction:
    """Every point that is not blended, or not in a band around the seam, as its lens sees it."""
    plain, shown = reconstruction(), np.swapaxes(shown_by(lenses), 0, 1).reshape(-1, 3)
    band = lenses if band_rad is None else replace(lenses, band_rad=band_rad)
    clear = ~band.blended(shown, plain.observation_frames)
    rays, origins = lenses.rays(shown, plain.observation_frames)
    own = {"observation_bearings": rays[clear], "observation_origins": origins[clear]}
    return observing(plain, clear, **own, lens_baseline=(0.4, 0.001))


def reprojection_errors(model: pycolmap.Reconstruction) -> np.ndarray:
    """Distances (O,) in pixels of a model's observations from its projected points."""
    seen = [(image, point) for image in model.images.values() for point in image.points2D]
    pairs = [(image.project_point(model.points3D[p.point3D_id].xyz), p.xy) for image, p in seen]
    return np.array([np.linalg.norm(shown - xy) for shown, xy in pairs])


def panoramas(
    folder: Path, suffix: str = ".png", masked: bool = False, lenses: Lenses | None = None
) -> FrameSet:
    """Write the panoramas, and masks that hide the lower fifth of the sphere."""
    names = tuple(f"frame_{f:04d}" for f in range(NUM_FRAMES))
    shared = lenses is None
    files = _of_one_centre(suffix) if shared else _encoded(shown_by(lenses), suffix)
    for name, content in zip(names, files, strict=True):
        write_bytes(folder / f"{name}{suffix}", content)
    mask_path = None
    if masked:
        mask_path = folder.parent / "mask.png"
        directions = erp_directions(WIDTH)
        cv2.imwrite(str(mask_path), (directions[..., 1] < 0.6).astype(np.uint8) * 255)
    paths = [(folder / f"{name}{suffix}",) for name in names]
    return frames_of(PictureFormat("erp", WIDTH, HEIGHT), paths, TIMES, names, mask_path)


def exported(
    folder: Path, to: ExportFormat, *given: Any, frames: FrameSet | None = None, **options: Any
) -> Path:
    """Folder `out` with an export of the scene, of panoramas that lie beside it or other frames."""
    frames = frames or panoramas(folder / "frames")
    export(reconstruction(), frames, folder / "out", to, *given, **options)
    return folder / "out"


def cube_frames(folder: Path, size: int = 128) -> FrameSet:
    """Write faces without up and down."""
    faces = ("front", "right", "back", "left")
    names = tuple(f"frame_{f:04d}" for f in range(NUM_FRAMES))
    rays = unit(
        np.concatenate(
            [pixel_centres(size, size) / (size / 2) - 1, np.ones((size, size, 1))], axis=-1
        )
    )
    for name, seen in zip(names, bearings(poses()), strict=True):
        for face in faces:
            directions = rays @ RIG_R_FACE[FACES.index(face)].T
            write_image(folder / face / f"{name}.png", picture(directions, seen))
    paths = [tuple(folder / face / f"{name}.png" for face in faces) for name in names]
    return frames_of(PictureFormat("cube", size, size, faces), paths, TIMES, names)


def assert_blob(
    image: np.ndarray, pixel: np.ndarray, color: np.ndarray, focal: float | None = None
) -> bool:
    """Check that a blob of this RGB colour is centred within 0.3 px of `pixel`, corner origin.

    The focal length is that of a square face of 90 degrees unless it is given.

    Returns whether there was anything to check: False where the blob is cut by the border.
    That leaves room for interpolation, 8 bits, and the perspective of a blob's spread (0.15 px
    together), not for pixels counted from another origin.
    """
    reach = int(np.ceil(4 * BLOB_RAD * (focal or image.shape[0] / 2)))
    column, row = np.floor(pixel).astype(int)
    height, width = image.shape[:2]
    if min(row, column) < reach or row >= height - reach or column >= width - reach:
        return False
    window = image[row - reach : row + reach + 1, column - reach : column + reach + 1]
    contrast = np.abs(window.astype(float) - 30).sum(axis=-1)
    contrast[contrast < 0.2 * contrast.max()] = 0
    rows, columns = np.mgrid[-reach : reach + 1, -reach : reach + 1] + 0.5
    centre = [(contrast * columns).sum(), (contrast * rows).sum()] / contrast.sum()
    assert np.linalg.norm(centre + np.array([column, row]) - pixel) < 0.3
    tints = unit(np.array([image[row, column], color]) - 30.0)
    assert tints[0] @ tints[1] > 0.8  # JPEG blurs chroma; 0.6 or less for any other colour
    return True


def moved_by_velocities(entry: dict, after_s: float) -> np.ndarray:
    """Pose of a frame of transforms.json after a time, as a trainer moves its camera."""
    turn, move = (np.array(entry[f"camera_{kind}_velocity"]) for kind in ("angular", "linear"))
    step = pose(Rotation.from_rotvec(turn * after_s).as_matrix(), move * after_s)
    return np.array(entry["transform_matrix"]) @ step


def contents(folder: Path) -> dict[str, bytes]:
    """Every file below a folder, by its relative path."""
    files = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}
