"""Folders of both tracks of a cube map: found, checked, resampled once into what is asked for."""

import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from cube_map_tracks import picture_tracks
from export_scene import reconstruction
from pixels import pixel_centres
from refusals import refused
from scipy.spatial.transform import Rotation
from two_fisheyes import colours, write

from factors.sphere_field import num_harmonics
from gsba.camera.cameras import Cameras
from gsba.camera.lens import ONE_CENTRE, Lenses
from gsba.camera.one_centre import Stitcher
from gsba.camera.rig import CubeRig
from gsba.camera.sphere import erp_directions
from gsba.camera.views import ViewCutter, cube_views, lens_views, rig_views
from gsba.export.dataset import Dataset, ExportFormat, ExportOptions
from gsba.export.images import panorama_writers, view_writers, write_pictures
from gsba.export.pictures import Files
from gsba.frames import cubemap, load_erp, load_grey, scan
from gsba.frames.pixels import Buffers, load_padded, pictures_of
from gsba.log import GsbaError
from gsba.placement.placement import Placement
from gsba.types import FACES, FrameSet

SIZE, OVERLAP, NUM = 96, 4, 3
REAL = Path(__file__).parents[3] / "shared" / "data" / "real" / "max_eac"
_TURN = Rotation.from_rotvec([0.8, -1.5, 0.4]).as_matrix()  # of a scene that is another
needs_real = pytest.mark.skipif(not REAL.is_dir(), reason="no ../shared/data/real/max_eac")


def _fill(folder: Path, names: tuple[str, str] = ("track0", "track5"), num: int = NUM) -> Path:
    for track, rgb in zip(names, picture_tracks(SIZE, OVERLAP, colours), strict=True):
        for n in range(num):
            write(folder / track / f"{n}.png", rgb)
    return folder


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> FrameSet:
    return scan(_fill(tmp_path_factory.mktemp("tracks")), order_suffices=True)


def _true(width: int) -> np.ndarray:
    return colours(erp_directions(width))


@pytest.mark.parametrize("second", ["track5", "track1", "Track4"])
def test_folders_are_found(tmp_path: Path, second: str) -> None:
    names = "track0", second
    (tmp_path / "STITCHED").mkdir()
    (tmp_path / "LICENSE").write_text("free")
    found = scan(_fill(tmp_path, names), order_suffices=True)
    assert (found.format.layout, found.format.tracks) == ("eac", (3 * SIZE + 2 * OVERLAP, SIZE))
    assert (found.format.width, found.format.height) == (4 * SIZE, 2 * SIZE)
    assert (
        found.names == ("0", "1", "2") and found.format.panoramic and found.format.lens_axes_known
    )
    assert [path.parent.name for path in found.paths[1]] == list(names)


@pytest.mark.parametrize("width", [4 * SIZE, 4 * SIZE - 6, 3 * SIZE, 130])
def test_panoramas_show_the_sphere(frames: FrameSet, width: int) -> None:
    found, true = load_erp(frames, 0, width=width), _true(width)
    assert found.shape == (width // 2, width, 3) and found.dtype == np.uint8
    off = np.abs(found - true)
    assert off.mean() < 0.6 and off.max() < 6  # grey levels: 0.3 is what rounding leaves
    grey, mask = load_grey(frames, 0, 4 * SIZE)
    assert mask is None
    assert np.abs(grey - _true(4 * SIZE) @ [0.299, 0.587, 0.114]).mean() < 0.6
    padded = load_padded(frames, 0, Buffers())
    np.testing.assert_array_equal(padded[4:-4, 4:-4], load_erp(frames, 0))


@pytest.mark.parametrize("rig", [CubeRig(64, np.pi / 2), CubeRig(120, np.deg2rad(100))])
def test_faces_show_the_sphere(frames: FrameSet, rig: CubeRig) -> None:
    """Cut in one step, as features, splats and exports of one lens have them."""
    pixels = pixel_centres(rig.size, rig.size)
    true = np.stack([colours(rig.bearings(pixels, face)) for face in range(6)])
    images, masks = cubemap.load(frames, 1, rig)
    assert masks is None
    assert np.abs(images - true).mean() < 0.6
    cutter = ViewCutter(rig_views(rig), ONE_CENTRE, 1)
    assert (
        np.abs(np.stack(list(cutter.cut(pictures_of(frames, 1, cutter.focal)))) - true).mean() < 0.7
    )


def test_faces_of_one_lens(frames: FrameSet) -> None:
    """What is far is where it is seen from the middle."""
    lenses = Lenses(centre=np.array([0, 0, 0.015]), band_rad=float(np.deg2rad(4)))
    views = lens_views(lenses, 64)
    cutter = ViewCutter(views, lenses, 0, 1e6 * np.random.default_rng(0).normal(size=(200, 3)))
    for view, image in zip(views, cutter.cut(pictures_of(frames, 0, cutter.focal)), strict=True):
        true = colours(view.rays(pixel_centres(view.width, view.height)))
        assert np.abs(image - true).mean() < 0.7


def test_panoramas_of_two_lenses_are_stitched_in_one_step(frames: FrameSet) -> None:
    lenses = Lenses(centre=np.array([0, 0, 0.015]), band_rad=float(np.deg2rad(4)))
    scene = 1e6 * np.random.default_rng(0).normal(size=(200, 3))
    found = Stitcher(lenses, 0, scene).stitched(pictures_of(frames, 0), 4 * SIZE)
    assert np.abs(found - _true(4 * SIZE)).mean() < 0.7


def test_exports_write_panoramas_and_faces(tmp_path: Path, frames: FrameSet) -> None:
    whole = Files(tmp_path, ("",), "erp/{name}{suffix}", "")
    faces = Files(tmp_path, FACES, "cube/{view}/{name}{suffix}", "")
    views = cube_views(FACES, 64)
    given = tmp_path, reconstruction(), frames, Cameras(), ExportFormat.COLMAP, "cube"
    data = Dataset(*given, Placement(), ExportOptions())
    writers = [panorama_writers(data, whole), view_writers(data, [faces], [views])]
    write_pictures(frames, writers)
    cut, _ = cubemap.load(frames, 2, CubeRig(64, np.pi / 2))
    for path, expected in [
        (tmp_path / "erp" / "2.png", load_erp(frames, 2)),
        *((tmp_path / "cube" / face / "2.png", cut[n]) for n, face in enumerate(FACES)),
    ]:
        shown = cv2.imread(str(path))
        np.testing.assert_array_equal(shown[..., ::-1], expected)


def test_corrections_are_applied_in_the_same_step(frames: FrameSet) -> None:
    """Cut with a field, faces show what a corrected panorama shows, but sharper."""
    rng = np.random.default_rng(3)
    correction = tuple(0.02 * rng.normal(size=num_harmonics(2)))
    bent = frames.with_formats([replace(frames.format, correction=correction)])
    rig = CubeRig(96, np.pi / 2)
    twice = cubemap.cut(load_erp(bent, 0), rig)
    once, _ = cubemap.load(bent, 0, rig)
    straight, _ = cubemap.load(frames, 0, rig)
    assert np.abs(once.astype(int) - twice).mean() < 0.8
    assert np.abs(once.astype(int) - straight).mean() > 2


def test_what_cannot_be_read_is_refused(tmp_path: Path) -> None:
    folder = _fill(tmp_path / "a")
    (folder / "track5" / "1.png").unlink()
    _refused(folder, "'track0/1.png' has no picture in track5/ of the other lens (1 of 3)")
    (folder / "track0" / "1.png").unlink()
    _refused(folder, "2 frames; at least 3 are needed")
    folder = _fill(tmp_path / "b")
    for path in (folder / "track5").iterdir():
        path.unlink()
    _refused(folder, "holds track0/ but no pictures of the second track")
    folder = _fill(tmp_path / "c")
    write(folder / "track3" / "0.png", np.zeros((SIZE, 3 * SIZE, 3), np.uint8))
    _refused(folder, "pictures in 3 folders, track0, track3, track5")
    folder = _fill(tmp_path / "d")
    write(folder / "track5" / "2.png", np.zeros((SIZE, 3 * SIZE, 3), np.uint8))
    one_size = "both lenses' pictures are of one size"
    _refused(folder, f"2.png: is 288x96, but 'track0/0.png' is 296x96: {one_size}")
    folder = tmp_path / "e"
    for track in ("track0", "track5"):
        for n in range(3):
            write(folder / track / f"{n}.png", np.zeros((SIZE, 2 * SIZE, 3), np.uint8))
    _refused(folder, "0.png: is 192x96, no track of a .360 recording")
    folder = _fill(tmp_path / "f")
    _, other = picture_tracks(SIZE, OVERLAP, lambda directions: colours(directions @ _TURN))
    for path in (folder / "track5").iterdir():
        write(path, other)
    _refused(folder, "track0 and track5 do not meet at their edges")
    folder = _fill(tmp_path / "g")
    table = folder / "lenses.yaml"
    table.write_text("")
    with pytest.raises(GsbaError, match="a calibration is for raw fisheyes"):
        scan(folder, order_suffices=True, calibration=table)


def _refused(folder: Path, why: str) -> None:
    refused(re.escape(why), scan, folder, order_suffices=True)


def test_frames_without_contrast_are_taken(tmp_path: Path) -> None:
    for track in ("track0", "track5"):
        for n in range(3):
            write(tmp_path / track / f"{n}.png", np.full((SIZE, 3 * SIZE + 8, 3), 20, np.uint8))
    assert scan(tmp_path, order_suffices=True).format.layout == "eac"


@needs_real
def test_panoramas_of_a_real_camera() -> None:
    """As another program stitched them, which takes the mean of four nearest pixels at a panorama
    pixel's corner and middle: a quarter of a pixel beside it, and coarser."""
    found = scan(REAL, order_suffices=True)
    assert found.names == tuple(f"GS018423_{n}" for n in (1, 2, 3, 4))
    for f, name in enumerate(found.names):
        stitched = cv2.imread(str(REAL / "STITCHED" / f"{name}.jpg"))
        off = np.abs(load_erp(found, f, width=2272) - stitched[..., ::-1].astype(int))
        assert off.mean() < 3.0  # 2.6 to 3.0; sampled where the other program does, 0.65
