"""A rendered walk taken by two fisheyes, refined and exported without a stitcher."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from command import run_gsba, succeed
from one_gallery import gallery
from pixels import pixel_centres
from splat_moves import shorten
from tiny_run import SETTINGS

from gsba.camera.calibration import calibration_json, read_calibration
from gsba.camera.fisheye import Pair, changed, project, rotation_of, unproject
from gsba.camera.sphere import erp_from_bearings
from gsba.camera.views import lens_views
from gsba.config import RefineSettings
from gsba.demo.degrade import degrade
from gsba.demo.render import Eye, render_erp, render_eye
from gsba.demo.two_lenses import poses_during
from gsba.demo.walk import walk_poses
from gsba.evaluate import TrajectoryErrors, evaluate
from gsba.frames.files import decode
from gsba.frames.pixels import load_erp
from gsba.log import GsbaError
from gsba.pipeline import refine
from gsba.store.finished import load_cameras, load_run
from gsba.trajectory.files import read_trajectory, write_tum
from gsba.types import Fisheye, Trajectory

pytestmark = pytest.mark.slow

BASELINE, NUM_FRAMES, SIZE = 0.05, 16, 448
BEND = (-0.025, 0.0018, 0.0, 0.0)
LENS = Fisheye(SIZE, SIZE, 0.30457 * SIZE, (SIZE / 2, SIZE / 2), BEND, (0.0, 0.0, 0.0))
LENSES: Pair = (LENS, replace(LENS, rotation=(0.0, np.pi, 0.0)))
RAW_SETTINGS = SETTINGS.model_copy(update={"patches": RefineSettings().patches})


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of front/, back/ and what the walk is beside it."""
    folder = tmp_path_factory.mktemp("raw")
    truth, scene = walk_poses("rectangle", "forward", NUM_FRAMES, 0), gallery()
    for name, lens, side in zip(("front", "back"), LENSES, (1, -1), strict=True):
        (folder / "frames" / name).mkdir(parents=True)
        maps = _maps(lens)
        for f, pose in enumerate(truth.world_T_rigs):
            at = pose.copy()
            at[:3, 3] += side * 0.5 * BASELINE * pose[:3, 2]
            _write_picture(folder / "frames" / name, f, render_erp(scene, at, 1024, 512), maps)
    _write_times(folder / "frames", truth)
    write_tum(folder / "truth.tum", truth)
    write_tum(folder / "slam.tum", degrade(truth, 0))
    _write(folder / "true.json", LENSES)
    off = np.array([-0.02, 0.008, -0.006, 0.02, 0, 0, 0, 0.008, -0.01, 0.006])
    _write(folder / "off.json", (changed(LENSES[0], off), changed(LENSES[1], -off)))
    return folder


def _maps(lens: Fisheye) -> np.ndarray:
    """Places (2, h, w) in a panorama of 1024 pixels; NaN beyond the circle."""
    pixels = pixel_centres(SIZE, SIZE)
    directions = unproject(lens, pixels)
    maps = np.moveaxis(erp_from_bearings(directions, 1024, 512) - 0.5, -1, 0).astype(np.float32)
    maps[:, directions @ rotation_of(lens)[:, 2] < np.cos(np.deg2rad(100))] = np.nan
    return maps


def _write_picture(folder: Path, frame: int, erp: np.ndarray, maps: np.ndarray) -> None:
    """A lens's picture, cut from a panorama at places by `_maps`."""
    pixels = erp.clip(0, 255).astype(np.uint8)
    picture = cv2.remap(pixels, maps[0], maps[1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_WRAP)
    picture[np.isnan(maps[0])] = 0
    cv2.imwrite(str(folder / f"{frame:04d}.png"), picture[..., ::-1])


def _write_times(folder: Path, truth: Trajectory) -> None:
    rows = [f"{f:04d},{time!r}" for f, time in enumerate(truth.timestamps.tolist())]
    (folder / "timestamps.csv").write_text("\n".join(rows))


def _write(path: Path, pair: Pair) -> None:
    centre = np.array([0, 0, BASELINE / 2])
    path.write_text(json.dumps(calibration_json(pair, centre, "m", {})))


def _refined(walk: Path, out: Path, calibration: str) -> tuple[dict, TrajectoryErrors]:
    refine(
        walk / "frames", walk / "slam.tum", out, RAW_SETTINGS, calibration=walk / calibration
    )  # fmt: skip
    report = json.loads((out / "report.json").read_text())
    truth = read_trajectory(walk / "truth.tum")
    return report, evaluate(read_trajectory(out / "trajectory.tum"), truth)


def test_raw_pairs_of_known_lenses_become_faces_of_either(
    walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    report, errors = _refined(walk, tmp_path / "run", "true.json")
    camera = report["camera"]
    assert camera["taken"] and not camera["lenses"]["taken"] and camera["lenses"]["reason"]
    assert camera["metres_per_unit"] == pytest.approx(errors.scale, rel=0.03)  # 1 unit = 1 m here
    assert errors.ate.rmse < 0.004
    assert len(list((tmp_path / "run/colmap/images").iterdir())) == 10
    kept = read_calibration(tmp_path / "run/calibration.json")
    assert kept[0].focal == LENS.focal
    np.testing.assert_allclose(kept[0].centre, [0, 0, BASELINE / 2], atol=0.001)
    _check_fisheyes(tmp_path / "run")
    _check_panoramas(walk, tmp_path / "run")
    monkeypatch.setattr("gsba.photometric.direct._DEPTH_LEVELS", 0)
    monkeypatch.setattr("gsba.photometric.patches._SPACING_DEG", 20.0)
    shorten(monkeypatch, first_steps=30, steps=10, held_out_every=8)
    _check_families(walk, tmp_path / "run")


def _check_fisheyes(run: Path) -> None:
    """Both pictures as they are, points where these show them; faces of one centre on request."""
    call = ["-q", "export", str(run), "--to", "colmap", "--images"]
    result = succeed(*call, "fisheye", "--out", run / "raw")
    model = pycolmap.Reconstruction(run / "raw/sparse/0")
    assert {camera.model.name for camera in model.cameras.values()} == {"OPENCV_FISHEYE"}
    assert model.compute_mean_reprojection_error() < 0.5
    masks = [cv2.imread(str(path), 0) for path in sorted((run / "raw/masks/front").iterdir())]
    assert all(mask is not None and mask[SIZE // 2, SIZE // 2] == 255 for mask in masks)
    assert all(mask is not None and mask[0, 0] == 0 for mask in masks)
    result = succeed(*call, "cube", "--out", run / "cube")
    assert len(list((run / "cube/images").iterdir())) == 6
    wrong = ["export", str(run), "--to", "tum", "--images", "fisheye"]
    result = run_gsba(*wrong, "--out", run / "no")
    assert result.exit_code == 1 and "colmap" in result.output and not (run / "no").exists()


def _check_panoramas(walk: Path, run: Path) -> None:
    """Stitched at the map's depth they are what one camera sees, better than joined at infinity."""
    call = ["-q", "export", str(run), "--to", "tum", "--images", "panorama"]
    succeed(*call, "--out", run / "panoramas")
    _, frames = load_run(run)
    truth, scene = read_trajectory(walk / "truth.tum"), gallery()
    size, off = (frames.format.width, frames.format.height), []
    for f in (3, 11):
        image = decode(run / f"panoramas/images/{frames.names[f]}.png", size)
        exact = render_erp(scene, truth.world_T_rigs[f], *size)
        off.append([_blurred_off(exact, found) for found in (image, load_erp(frames, f))])
    stitched, joined = np.mean(off, axis=0)
    assert stitched < 0.3 * joined, (stitched, joined)


def _blurred_off(exact: np.ndarray, found: np.ndarray) -> float:
    off = exact.astype(np.float32) - found
    return float(np.abs(cv2.GaussianBlur(off, (0, 0), 1.5)).mean())


def _check_families(walk: Path, run: Path) -> None:
    """Pixels of the lenses have their say, each from its own; a splat is trained on them."""
    more = {
        "factors": ("bearing", "photometric", "splat"),
        "splat": {"sizes": (24,), "backend": "cpu"},
    }
    settings = RefineSettings.model_validate(RAW_SETTINGS.model_dump() | more)
    refine(walk / "frames", walk / "slam.tum", run, settings, calibration=walk / "true.json")
    report, truth = (
        json.loads((run / "report.json").read_text()),
        read_trajectory(walk / "truth.tum"),
    )
    computed = [stage["name"] for stage in report["stages"] if not stage["resumed"]]
    assert computed[:2] == ["photometric", "splat"] and len(report["splat"]) == 1
    assert evaluate(read_trajectory(run / "trajectory.tum"), truth).ate.rmse < 0.004
    train = ["-q", "train", str(run), "--iterations", "20", "--face-size", "32", "--backend", "cpu"]
    succeed(*train)
    (picture, *_) = sorted((run / "splat/pictures").iterdir())
    views = lens_views(load_cameras(run, *load_run(run)).only, 32)
    shown = cv2.imread(str(picture))
    assert shown is not None and shown.shape[1] == sum(view.width for view in views)
    assert shown[:20].mean() > 40  # captured: nothing of the black around the circles


def test_lenses_that_are_off_are_found_and_all_is_done_anew(walk: Path, tmp_path: Path) -> None:
    report, errors = _refined(walk, tmp_path / "run", "off.json")
    assert report["camera"]["lenses"]["taken"]
    assert errors.ate.rmse < 0.01
    found = read_calibration(tmp_path / "run/calibration.json")
    given = read_calibration(walk / "off.json")
    assert _off_px(found) < 0.1 * _off_px(given)
    before = (tmp_path / "run/trajectory.tum").read_bytes()
    again, _ = _refined(walk, tmp_path / "run", "off.json")
    assert (tmp_path / "run/trajectory.tum").read_bytes() == before
    anew = {stage["name"] for stage in again["stages"] if not stage["resumed"]}
    assert anew <= {"frames"}


def _off_px(pair: Pair) -> float:
    """How far directions are from their true pixels, up to a turn of the rig, rms."""
    rng = np.random.default_rng(0)
    there, here = [], []
    for lens, true in zip(pair, LENSES, strict=True):
        angles, around = rng.uniform(0.1, 1.5, 400), rng.uniform(0, 2 * np.pi, 400)
        local = np.stack(
            [np.sin(angles) * np.cos(around), np.sin(angles) * np.sin(around), np.cos(angles)], 1
        )
        here.append(local @ rotation_of(true).T)
        there.append(unproject(lens, project(true, here[-1])))
    a, b = np.concatenate(there), np.concatenate(here)
    u, _, v = np.linalg.svd(a.T @ b)
    return float(np.sqrt(np.mean(np.sum((a @ (u @ v) - b) ** 2, axis=1))) * LENS.focal)


def test_a_calibration_is_not_for_panoramas(walk: Path, tmp_path: Path) -> None:
    folder = tmp_path / "stitched"
    folder.mkdir()
    for f in range(4):
        cv2.imwrite(str(folder / f"{f}.png"), np.full((64, 128, 3), 90 + f, np.uint8))
    trajectory = Trajectory(np.arange(4.0), np.tile(np.eye(4), (4, 1, 1)))
    trajectory.world_T_rigs[:, 2, 3] = np.arange(4)
    write_tum(tmp_path / "slam.tum", trajectory)
    with pytest.raises(GsbaError, match=r"true\.json"):
        refine(
            folder, tmp_path / "slam.tum", tmp_path / "run", fps=1.0,
            calibration=walk / "true.json",
        )  # fmt: skip
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("readout_s", [0.02, 0.0])
def test_six_frames_tell_rows_read_one_after_another(readout_s: float, tmp_path: Path) -> None:
    truth, scene = walk_poses("rectangle", "forward", 24, 0), gallery()
    truth = Trajectory(truth.timestamps[:6], truth.world_T_rigs[:6])
    during = poses_during(truth, readout_s, 0)[:, :, :3]
    for name, lens, side in zip(("front", "back"), LENSES, (1.0, -1.0), strict=True):
        (tmp_path / "frames" / name).mkdir(parents=True)
        maps = _maps(lens)
        for f, poses in enumerate(during):
            eyes = poses.copy()
            eyes[:, :, 3] += side * 0.5 * BASELINE * poses[:, :, 2]
            eye = Eye(eyes, side, (0.0, 1.0), np.deg2rad(100), BEND[:2], -0.2)
            _write_picture(tmp_path / "frames" / name, f, render_eye(scene, eye, 1024, 512), maps)
    _write_times(tmp_path / "frames", truth)
    _write(tmp_path / "true.json", LENSES)
    given = tmp_path / "frames", None, tmp_path / "run", RAW_SETTINGS
    result = refine(*given, calibration=tmp_path / "true.json")
    camera = result.report["camera"]
    assert camera["readout"]["taken"] == bool(readout_s)
    errors = evaluate(read_trajectory(tmp_path / "run/trajectory.tum"), truth)
    assert errors.ate.rmse < 0.001
    assert camera["baseline"] * errors.scale == pytest.approx(BASELINE, rel=0.02)


REAL = Path(__file__).parents[3] / "shared/data/real"


def test_a_circle_goes_without_a_calibration(walk: Path, tmp_path: Path) -> None:
    given = {"calibration": walk / "true.json", "circles": [(224.0, 224.0, 220.0)]}
    with pytest.raises(GsbaError, match=r"--circle and --calibration .*true\.json both say"):
        refine(walk / "frames", walk / "slam.tum", tmp_path / "run", **given)
    arguments = [str(walk / "frames"), str(walk / "slam.tum"), "--out", str(tmp_path / "run")]
    for text, message in (("1,2", "three numbers"), ("9,9,-3", "positive radius")):
        result = run_gsba("-q", "refine", *arguments, "--circle", text)
        assert result.exit_code == 1 and message in result.output
    assert not (tmp_path / "run").exists()


@pytest.mark.skipif(not (REAL / "fusion_wood").is_dir(), reason="real captures are not here")
def test_a_fusion_capture_runs_from_its_own_files(tmp_path: Path) -> None:
    result = refine(REAL / "fusion_wood", None, tmp_path / "run", fps=1.0)
    summary, camera = result.report["summary"], result.report["camera"]
    assert summary["refined"] == 6
    assert summary["median_residual_deg"] < 0.06
    assert camera["lenses"]["taken"]
    # The walker makes about a metre a second: 20 to 45 mm between the lenses.
    poses = read_trajectory(tmp_path / "run/trajectory.tum").world_T_rigs
    step = np.median(np.linalg.norm(np.diff(poses[1:, :3, 3], axis=0), axis=1))
    assert camera["baseline_sigma"] < 0.005 * step
    assert 0.015 < camera["baseline"] / step < 0.05
