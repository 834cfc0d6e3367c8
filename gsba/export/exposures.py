"""Relative exposures of frames, from the brightness of the map's points in exported images.

The brightness of a point in a frame is the sum of both's in stops, by robust least squares, of
pixels made linear by sRGB's curve. gsplat (`--load_exposure`) and 3DGRUT read log2(ExposureTime /
FNumber^2 * ISO) less its mean from the EXIF of JPEGs: `ExposureTime` is written, 10 ms for the
mean.
"""

import logging
from pathlib import Path

import cv2
import numpy as np

from gsba.disk import write_bytes, write_json

logger = logging.getLogger(__name__)

_DARKEST, _BRIGHTEST = 16, 245  # of 255: beyond, noise or clipping changes the brightness
_PER_SECOND = 100_000_000  # denominator of an exposure time


def write_exposures(partial: Path) -> None:
    """Write the exposures of a COLMAP dataset, whose images and model are complete. Raises
    GsbaError: the disk cannot be written."""
    import pycolmap

    model = pycolmap.Reconstruction(partial / "sparse" / "0")
    brightness, frames, points = [], [], []
    for image in model.images.values():
        seen = [point for point in image.points2D if point.has_point3D()]
        if not seen:
            continue
        pixels = np.array([point.xy for point in seen])
        values = _brightness(partial / "images" / image.name, pixels)
        brightness.append(values)
        points.append(np.array([point.point3D_id for point in seen]))
        frames.append(np.full(len(seen), image.frame_id))
    if not frames:
        logger.warning("exposures are unknown: the images show no points")
        return
    numbers, rows = np.unique(np.concatenate(frames), return_inverse=True)
    found = relative_exposures(np.concatenate(brightness), rows, np.concatenate(points))
    known = {
        f: ev for f, ev in zip(numbers.tolist(), found.tolist(), strict=True) if np.isfinite(ev)
    }
    told = {i.name: known[i.frame_id] for i in model.images.values() if i.frame_id in known}
    inserted = [_insert_exposure(partial / "images" / name, ev) for name, ev in told.items()]
    if not any(inserted):
        logger.warning("exposures are in exposures.json alone: no image is a JPEG")
    write_json(partial / "exposures.json", {name: round(ev, 4) for name, ev in told.items()})
    range_ = f"{min(known.values()):+.2f} to {max(known.values()):+.2f}" if known else "none"
    logger.info("exposures of %d frames: %s EV", len(known), range_)


def relative_exposures(
    brightness: np.ndarray, frames: np.ndarray, points: np.ndarray
) -> np.ndarray:
    """Exposures (F,) of frames in stops, of mean 0; NaN = no pixel of the frame tells it.

    Args:
        brightness: (O,) float64, of observations, stops; NaN = unknown.
        frames: (O,) int, frame of each, from 0.
        points: (O,) int, number of the point of each.
    """
    from scipy.sparse import csr_array, diags_array
    from scipy.sparse.linalg import spsolve

    num_frames = int(frames.max(initial=-1)) + 1
    seen = np.isfinite(brightness)
    values, rows = brightness[seen], frames[seen]
    labels, columns = np.unique(points[seen], return_inverse=True)
    num_points, weights = len(labels), np.ones(len(values))
    exposures = np.zeros(num_frames)
    for _ in range(10 if len(values) else 0):  # of reweighting
        table = csr_array((weights, (rows, columns)), (num_frames, num_points))
        per_frame = np.bincount(rows, weights, num_frames)
        per_point = np.bincount(columns, weights, num_points)
        shares = table @ diags_array(1 / per_point)
        # The mean of all is free, as is that of frames without a common point.
        normal = diags_array(per_frame + 1e-9 * per_frame.max()) - shares @ table.T
        right = np.bincount(rows, weights * values, num_frames)
        right -= shares @ np.bincount(columns, weights * values, num_points)
        exposures = np.asarray(spsolve(normal.tocsc(), right))
        left_over = values - exposures[rows]
        residuals = left_over - (np.bincount(columns, weights * left_over) / per_point)[columns]
        sigma = max(1.4826 * float(np.median(np.abs(residuals))), 1e-3)
        weights = 1 / (1 + (residuals / (2.4 * sigma)) ** 2)  # robust standard deviations
    shared = np.bincount(columns, minlength=num_points)[columns] > 1
    tied = np.bincount(rows[shared], minlength=num_frames) > 0
    return np.where(tied, exposures - exposures[tied].sum() / max(tied.sum(), 1), np.nan)


def _brightness(path: Path, pixels: np.ndarray) -> np.ndarray:
    """Brightness (N,) in stops of an image around pixels (N, 2), corner origin; NaN = unknown."""
    # Means of 2 x 2 pixels: single ones are noisier, of 4 x 4 the surroundings have a part.
    small = cv2.imread(str(path), cv2.IMREAD_REDUCED_COLOR_2)
    if small is None:
        return np.full(len(pixels), np.nan)
    height, width = small.shape[:2]
    columns, rows = (np.floor(pixels / 2).astype(int)).T
    colors = small[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)]
    known = (colors >= _DARKEST).all(axis=1) & (colors <= _BRIGHTEST).all(axis=1)
    linear = ((colors / 255 + 0.055) / 1.055) ** 2.4  # the curve's foot is darker than _DARKEST
    luminance = linear @ np.array([0.0722, 0.7152, 0.2126])  # of blue, green and red (BT.709)
    return np.where(known, np.log2(np.maximum(luminance, 1e-6)), np.nan)


def _insert_exposure(path: Path, exposure: float) -> bool:
    """Write an exposure in stops into a JPEG, if it has no EXIF; False = it is no JPEG."""
    from PIL import ExifTags, Image
    from PIL.TiffImagePlugin import IFDRational

    content = path.read_bytes()
    if not content.startswith(b"\xff\xd8"):
        return False
    if b"Exif\0\0" in content[: 1 << 16]:
        return True
    exif = Image.Exif()
    parts = round(0.01 * 2**exposure * _PER_SECOND)
    tags = exif.get_ifd(ExifTags.IFD.Exif)
    tags[ExifTags.Base.ExposureTime] = IFDRational(parts, _PER_SECOND)
    segment = exif.tobytes()
    header = b"\xff\xe1" + (len(segment) + 2).to_bytes(2, "big")
    write_bytes(path, content[:2] + header + segment + content[2:])
    return True
