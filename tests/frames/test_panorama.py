"""Grey panoramas of frames of either layout."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from pixels import pixel_centres
from plain_records import frames_of

from gsba.camera.rig import CubeRig
from gsba.camera.sphere import erp_directions
from gsba.frames.panorama import load_grey, width_for
from gsba.types import FACES, FrameSet, PictureFormat

SIZE = 64


def _smooth(bearings: np.ndarray) -> np.ndarray:
    x, y, z = np.moveaxis(bearings, -1, 0)
    return 120 + 40 * x * y + 30 * np.sin(4 * z) + 20 * x


def _cube(folder: Path, faces: tuple[str, ...]) -> FrameSet:
    rig, paths, grid = CubeRig(SIZE, np.pi / 2), [], pixel_centres(SIZE, SIZE)
    for name in faces:
        paths.append(folder / f"{name}.png")
        image = np.rint(_smooth(rig.bearings(grid, FACES.index(name))))
        cv2.imwrite(str(paths[-1]), image.astype(np.uint8))
    return frames_of(PictureFormat("cube", SIZE, SIZE, faces), [tuple(paths)])


def test_cube_faces_join_without_a_seam(tmp_path: Path) -> None:
    frames = _cube(tmp_path, FACES)
    width = width_for(frames.format, 4096)
    grey, mask = load_grey(frames, 0, width)
    assert grey.shape == (2 * SIZE, 4 * SIZE) and mask is None
    # Rounded twice, once in the faces and once here; cubic between pixels.
    np.testing.assert_allclose(grey, _smooth(erp_directions(width)), atol=1.6)


def test_large_cube_faces_are_averaged_down(tmp_path: Path) -> None:
    frames, width = _cube(tmp_path, FACES), SIZE
    grey, mask = load_grey(frames, 0, width)
    assert grey.shape == (width // 2, width) and mask is None
    np.testing.assert_allclose(grey, _smooth(erp_directions(width)), atol=2.0)


def test_missing_faces_are_masked(tmp_path: Path) -> None:
    frames = _cube(tmp_path, FACES[:4])
    _, mask = load_grey(frames, 0, width_for(frames.format, 4096))
    around = np.linspace(-np.pi / 4, np.pi / 4, 1001)  # of a face, whose edge is at atan(cos)
    expected = np.mean(np.arctan(np.cos(around))) / (np.pi / 2)
    assert mask is not None and mask.mean() == pytest.approx(expected, abs=0.01)
    assert mask[SIZE].all() and not mask[0].any() and not mask[-1].any()


def test_wide_panoramas_are_averaged_down(tmp_path: Path) -> None:
    path, mask_path = tmp_path / "a.png", tmp_path / "mask.png"
    rng = np.random.default_rng(0)
    image = rng.integers(0, 255, (64, 128), dtype=np.uint8)
    cv2.imwrite(str(path), image)
    allowed = np.full((64, 128), 255, np.uint8)
    allowed[10, 20] = 0
    cv2.imwrite(str(mask_path), allowed)
    frames = frames_of(PictureFormat("erp", 128, 64), [(path,)], mask=mask_path)
    width = width_for(frames.format, 100)
    assert width == 64
    grey, mask = load_grey(frames, 0, width)
    expected = image.reshape(32, 2, 64, 2).mean(axis=(1, 3))
    np.testing.assert_allclose(grey, expected, atol=0.6)
    assert mask is not None and not mask[5, 10] and np.count_nonzero(~mask) == 1


@pytest.mark.parametrize(("width", "limit", "expected"), [(1536, 4096, 1536), (5376, 4096, 2688)])
def test_width(width: int, limit: int, expected: int) -> None:
    assert width_for(PictureFormat("erp", width, width // 2), limit) == expected
