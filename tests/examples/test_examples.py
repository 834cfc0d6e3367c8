"""The examples of families, run as their docstrings say on small rendered walks."""

import ast
import shutil
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import cv2
import gtsam
import numpy as np
import pytest
from one_gallery import gallery

from factors.check import jacobian_errors
from gsba import PointObservations, RefineSettings, RunResult
from gsba.camera.sphere import erp_directions
from gsba.demo import make_walk
from gsba.demo.raycast import ranges
from gsba.similarity import pose_similarity
from gsba.trajectory.files import read_trajectory

EXAMPLES = Path(__file__).parents[2] / "examples"
NUM_FRAMES, WIDTH, TAG = 11, 768, 0.5
LIGHTER = {
    "cubemap": {"min_face_size": 256, "max_face_size": 256},
    "features": {"max_per_face": 250},
    "weak_frames": {"mode": "off"},
    "patches": {"rounds": 0},
}


@pytest.fixture(scope="module", autouse=True)
def _examples_are_modules() -> Iterator[None]:
    settings = RefineSettings.model_validate(LIGHTER)
    refine = sys.modules["gsba.pipeline.refine"].refine

    def lighter(frames, trajectory, out, own=settings, **more):
        light = settings.model_copy(update={"factors": own.factors})
        return refine(frames, trajectory, out, light, **more)

    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(EXAMPLES))
        patch.setattr("gsba.refine", lighter, raising=False)
        yield


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demo's gallery, with tags on the walls beside the way."""
    folder = tmp_path_factory.mktemp("examples") / "walk"
    make_walk(folder, "open", "locked", NUM_FRAMES, WIDTH)
    truth = read_trajectory(folder / "groundtruth.tum").world_T_rigs
    tags = _hung(truth[2::4])
    for world_T_rig, path in zip(truth, sorted((folder / "images").glob("*.jpg")), strict=True):
        image = cv2.imread(str(path))
        assert image is not None
        cv2.imwrite(str(path), _with_tags(image, world_T_rig, tags), [cv2.IMWRITE_JPEG_QUALITY, 95])
    return folder


def _hung(world_T_rigs: np.ndarray) -> list[np.ndarray]:
    """Poses of tags before what frames see to their left and right, turned towards them."""
    scene, tags = gallery(), []
    for world_T_rig in world_T_rigs:
        sides = np.array([-1.0, 1.0])[:, None] * world_T_rig[:3, 0]
        sides[:, 1] = 0.0
        sides /= np.linalg.norm(sides, axis=1, keepdims=True)
        for toward, away in zip(sides, ranges(scene, world_T_rig[:3, 3], sides), strict=True):
            y = np.array([0.0, -1.0, 0.0])
            pose = np.eye(4)
            pose[:3, :3] = np.stack([np.cross(y, -toward), y, -toward], axis=1)
            pose[:3, 3] = world_T_rig[:3, 3] + min(0.9 * away, 2.0) * toward
            tags.append(pose)
    return tags


def _with_tags(image: np.ndarray, world_T_rig: np.ndarray, tags: list[np.ndarray]) -> np.ndarray:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    rays = _fine_rays(image.shape[1])
    fine = cv2.resize(image, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
    for number, tag in enumerate(tags):
        offset = (tag[:3, 3] - world_T_rig[:3, 3]) @ tag[:3, 2]
        if offset >= 0:  # seen from behind
            continue
        picture = cv2.aruco.generateImageMarker(dictionary, number, 800)
        picture = cv2.copyMakeBorder(picture, 100, 100, 100, 100, cv2.BORDER_CONSTANT, value=255)
        rows, columns = np.nonzero(_around(rays, world_T_rig, tag))
        near = rays[rows, columns] @ world_T_rig[:3, :3].T
        far = offset / (near @ tag[:3, 2])
        hits = world_T_rig[:3, 3] + far[:, None] * near - tag[:3, 3]
        x, y = hits @ tag[:3, 0] / TAG, hits @ tag[:3, 1] / TAG
        inside = (far > 0) & (np.abs(x) < 0.625) & (np.abs(y) < 0.625)
        s = np.clip((x[inside] + 0.5) * 800 + 100, 0, 999).astype(int)
        t = np.clip((0.5 - y[inside]) * 800 + 100, 0, 999).astype(int)
        fine[rows[inside], columns[inside]] = picture[t, s][:, None]
    return cv2.resize(fine, (image.shape[1], image.shape[0]), interpolation=cv2.INTER_AREA)


@cache
def _fine_rays(width: int) -> np.ndarray:
    """Directions of the pixels of a panorama of twice the width, (width, 2 width, 3)."""
    return erp_directions(2 * width).astype(np.float32)


def _around(rays: np.ndarray, world_T_rig: np.ndarray, tag: np.ndarray) -> np.ndarray:
    """Pixels (H, W) bool whose rays (H, W, 3) of the rig meet the sphere around a tag."""
    centre = (world_T_rig[:3, :3].T @ (tag[:3, 3] - world_T_rig[:3, 3])).astype(np.float32)
    along = rays @ centre
    return (centre @ centre - along**2 < (0.9 * TAG) ** 2) & (along > 0)


def _scale_and_error(walk: Path, world_T_rigs: np.ndarray) -> tuple[float, float]:
    """Units of the truth per unit of the result, and the ATE in them after alignment."""
    truth = read_trajectory(walk / "groundtruth.tum").world_T_rigs
    fit = pose_similarity(world_T_rigs, truth)
    off = fit.points(world_T_rigs[:, :3, 3]) - truth[:, :3, 3]
    return fit.scale, float(np.sqrt(np.mean(np.sum(off**2, axis=1))))


@pytest.fixture(scope="module")
def barometer_run(walk: Path, tmp_path_factory: pytest.TempPathFactory) -> RunResult:
    import barometer

    return barometer.main(walk, tmp_path_factory.mktemp("barometer") / "run")


@pytest.fixture
def out(barometer_run: RunResult, tmp_path: Path) -> Path:
    """A run whose stages before the first solution are those of a run with any other family."""
    return Path(shutil.copytree(barometer_run.out, tmp_path / "run"))


def test_a_barometer_finds_its_bias(walk: Path, barometer_run: RunResult) -> None:
    import barometer

    result = barometer_run
    assert result.report["families"]["barometer"]["bias_m"] == pytest.approx(100.0, abs=0.02)
    assert _scale_and_error(walk, result.reconstruction.world_T_rigs)[1] < 5e-3
    resumed = barometer.main(walk, result.out)
    assert all(stage["resumed"] for stage in resumed.report["stages"])


@pytest.mark.slow
def test_wheels_set_the_scale(walk: Path, out: Path) -> None:
    import wheel_odometry

    result = wheel_odometry.main(walk, out)
    scale, error = _scale_and_error(walk, result.reconstruction.world_T_rigs)
    assert 2.5 * scale == pytest.approx(1.0, rel=0.01)  # ten steps, each to 1 %
    assert error < 5e-3
    assert "wheels" in result.report["gauge"]


def test_a_loss_of_ones_own_gives_up_slipped_steps(walk: Path, out: Path) -> None:
    import robust_loss

    result = robust_loss.main(walk, out)
    scale, error = _scale_and_error(walk, result.reconstruction.world_T_rigs)
    assert 2.5 * scale == pytest.approx(1.0, rel=0.01)
    assert error < 5e-3


def test_the_general_loss_is_the_integral_of_its_weight() -> None:
    from robust_loss import GeneralLoss

    for shape in (1.0, -2.0, -4.0):
        loss, step = GeneralLoss(shape, 1.5), 1e-5
        assert loss.weight(0.0) == pytest.approx(1.0)
        for residual in (0.3, 1.4, 6.0):
            slope = (loss.loss(residual + step) - loss.loss(residual - step)) / (2 * step)
            assert slope == pytest.approx(loss.weight(residual) * residual, rel=1e-6)


@pytest.mark.slow
def test_a_floor_finds_its_plane(walk: Path, out: Path) -> None:
    import floor_plane

    result = floor_plane.main(walk, out)
    normal = np.array(result.report["families"]["floor"]["normal"])
    assert abs(normal[1]) > 0.99
    assert _scale_and_error(walk, result.reconstruction.world_T_rigs)[1] < 1e-2


def test_points_are_refined_by_a_residual_of_ones_own(walk: Path, out: Path) -> None:
    import panorama_pixels

    result = panorama_pixels.main(walk, out)
    costs = [
        step["costs"]
        for stage in result.report["solver"]
        for one in stage["rounds"]
        for step in one["iterations"]
        if step["accepted"]
    ]
    assert all("bearing" not in some and some["panorama_pixels"] > 0 for some in costs)
    assert _scale_and_error(walk, result.reconstruction.world_T_rigs)[1] < 5e-3


def test_pixels_of_two_lenses_are_seen_from_each() -> None:
    import panorama_pixels

    bearings, indices = np.eye(3), np.arange(3)  # the second one is at the pole
    origins = np.array([[0.0, 0, 0.02], [0.0, 0, 0.02], [0.0, 0, -0.02]])
    given = indices, indices, bearings, np.full(3, 1e-3), None
    observed = PointObservations(*given, origins, np.zeros(3, np.uint8), np.zeros((3, 2)))
    (term,) = panorama_pixels.PanoramaPixels().landmark_terms(observed)
    np.testing.assert_array_equal(term.origins_rig, origins[[0, 2]])


def test_tags_set_the_scale(walk: Path, out: Path) -> None:
    import april_tags

    result = april_tags.main(walk / "images", walk / "slam.tum", out, TAG)
    assert len(result.report["families"]["tags"]) >= 4
    scale, error = _scale_and_error(walk, result.reconstruction.world_T_rigs)
    assert scale == pytest.approx(1.0, rel=0.01)
    assert error < 5e-3


def test_jacobians_of_the_examples() -> None:
    import april_tags
    import barometer
    import floor_plane
    import panorama_pixels

    rng, values = np.random.default_rng(0), gtsam.Values()
    x = gtsam.symbol("x", 0)
    values.insert(x, gtsam.Pose3(gtsam.Rot3.Expmap(rng.normal(size=3)), rng.normal(size=3)))
    values.insert(barometer.B, rng.normal(size=2))
    values.insert(floor_plane.N, gtsam.Unit3(rng.normal(size=3)))
    values.insert(floor_plane.D, 0.3)
    tag = gtsam.symbol("T", 0)
    values.insert(tag, gtsam.Pose3(gtsam.Rot3.Expmap(rng.normal(size=3)), rng.normal(size=3)))
    values.insert(gtsam.symbol("l", 0), np.array([3.0, -1.0, 4.0]))
    one, eight = (gtsam.noiseModel.Isotropic.Sigma(n, 0.1) for n in (1, 8))
    bearings = rng.normal(size=(4, 3))
    bearings /= np.linalg.norm(bearings, axis=1)[:, None]
    corners = april_tags.AprilTags([], 0.2)._error_of([x, tag], bearings)
    for factor in (
        gtsam.CustomFactor(one, [x, barometer.B], barometer._error_of(0.4)),
        gtsam.CustomFactor(one, [x, floor_plane.N, floor_plane.D], floor_plane._error),
        gtsam.CustomFactor(eight, [x, tag], corners),
        panorama_pixels.longitude_and_latitude.factor(
            x, gtsam.symbol("l", 0), bearings[0], gtsam.noiseModel.Isotropic.Sigma(2, 0.1)
        ),
    ):
        assert max(jacobian_errors(factor, values).values()) < 1e-5


def test_examples_are_short() -> None:
    """At most 80 lines of code each: docstrings, comments and blank lines aside."""
    for path in EXAMPLES.glob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for node in ast.walk(tree):
            documented = isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)
            if documented and ast.get_docstring(node):
                node.body = node.body[1:] or [ast.Pass()]
        assert len(ast.unparse(tree).split("\n")) <= 80, path
