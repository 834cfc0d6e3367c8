"""Exposures of frames, estimated from the map's points, and read back as gsplat and 3DGRUT do."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from export_scene import NUM_FRAMES, exported, panoramas, reconstruction
from PIL import Image

from gsba.disk import write_image
from gsba.export import ExportFormat, export
from gsba.export.exposures import relative_exposures
from gsba.export.trainers import how_to_start
from gsba.log import GsbaError


def test_exposures_are_found_in_spite_of_noise_and_outliers() -> None:
    """A long walk, on which each point is seen in eight frames."""
    rng = np.random.default_rng(0)
    truth = np.cumsum(rng.normal(0, 0.2, 60))
    truth -= truth.mean()
    frames = (np.arange(2000)[:, None] * 53 // 2000 + np.arange(8)).ravel()
    points = np.repeat(np.arange(2000), 8)
    brightness = truth[frames] + rng.normal(0, 2, 2000)[points] + rng.normal(0, 0.1, 16000)
    brightness[rng.random(16000) < 0.1] += rng.normal(2, 1)  # reflections
    brightness[rng.random(16000) < 0.1] = np.nan
    found = relative_exposures(brightness, frames, points)
    assert found.mean() == pytest.approx(0, abs=1e-9)
    # 38 to 300 points a frame: the standard deviation of a step is 0.01 to 0.02.
    np.testing.assert_allclose(found, truth, atol=0.1)
    np.testing.assert_allclose(np.diff(found), np.diff(truth), atol=0.09)


def test_frames_without_common_points_are_unknown() -> None:
    frames, points = np.array([0, 1, 2, 0, 1]), np.array([0, 0, 1, 2, 2])
    found = relative_exposures(np.array([0.0, 1, 5, 1, 2]), frames, points)
    np.testing.assert_allclose(found, [-0.5, 0.5, np.nan], atol=1e-6)
    assert np.isnan(relative_exposures(np.full(5, np.nan), frames, points)).all()


def _exif_stops(path: Path) -> float:
    """Exposure by the rule of gsplat's and 3DGRUT's exif.py, of which only the time is known."""
    seconds = Image.open(path).getexif().get_ifd(0x8769)[33434]
    return float(np.log2(float(seconds)))


def test_trainers_read_how_frames_were_exposed(tmp_path: Path) -> None:
    frames = panoramas(tmp_path / "frames", ".jpg")
    stops = np.linspace(-0.8, 0.8, NUM_FRAMES)
    for (path,), stop in zip(frames.paths, stops, strict=True):
        image = cv2.imread(str(path))
        linear = (0.04 + 0.2 * image[..., ::-1] / 255) * 2**stop  # far from black and white
        write_image(path, np.rint(255 * (1.055 * linear ** (1 / 2.4) - 0.055)).astype(np.uint8))
    out = tmp_path / "out"
    export(
        reconstruction(), frames, out, ExportFormat.COLMAP_FLAT, 256, split=False, exposures=True
    )
    told = json.loads((out / "exposures.json").read_text())
    images = sorted(path.name for path in (out / "images").iterdir())
    assert sorted(told) == images and len(images) == 6 * NUM_FRAMES
    read = np.array([_exif_stops(out / "images" / name) for name in images])
    read -= read.mean()
    np.testing.assert_allclose(read, [told[name] for name in images], atol=1e-3)
    by_frame = read.reshape(NUM_FRAMES, 6)
    assert np.ptp(by_frame, axis=1).max() < 1e-6  # all faces of a frame have one exposure
    np.testing.assert_allclose(by_frame[:, 0], stops, atol=0.1)
    assert cv2.imread(str(out / "images" / images[0])) is not None


def test_an_interrupted_export_does_not_go_on_as_one_without_exposures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    frames, out = panoramas(tmp_path / "frames", ".jpg"), tmp_path / "out"

    def stopped(partial: Path) -> None:
        (partial / "exposures.json").write_text("{}\n")
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr("gsba.export.formats.write_exposures", stopped)
        export(reconstruction(), frames, out, ExportFormat.COLMAP, 64, exposures=True)
    export(reconstruction(), frames, out, ExportFormat.COLMAP, 64)
    assert not (out / "exposures.json").exists()


def test_images_that_hold_no_exif_are_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    out = exported(tmp_path, ExportFormat.COLMAP_FLAT, 64, exposures=True)
    assert json.loads((out / "exposures.json").read_text())
    assert "exposures are in exposures.json alone: no image is a JPEG" in caplog.text
    assert how_to_start("gsplat", out)[1:] == []
    assert how_to_start("brush", out)[1:] == ["brush reads no exposures"]


@pytest.mark.parametrize("to", ["nerfstudio", "opensfm"])
def test_formats_whose_programs_read_none_are_refused(to: str, tmp_path: Path) -> None:
    frames, out = panoramas(tmp_path / "frames"), tmp_path / "out"
    with pytest.raises(GsbaError, match=f"exposures go with colmap and colmap-flat, not with {to}"):
        export(reconstruction(), frames, out, ExportFormat(to), exposures=True)
    assert not out.exists()
