"""The example of a lens projection, run on rendered raw pictures of such lenses."""

import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from ring_of_lenses import SIZE, distance, render, ring, write_calibration
from tiny_run import SETTINGS

from gsba.camera.calibration import read_calibration
from gsba.camera.fisheye import project
from gsba.evaluate import evaluate
from gsba.log import GsbaError
from gsba.trajectory.files import read_trajectory

EXAMPLES = Path(__file__).parents[2] / "examples"
FOCAL = SIZE / 2 / (2 * np.sin(np.deg2rad(50.0)))  # 100 degrees reach the picture's edge


@pytest.fixture(autouse=True)
def _examples_are_modules(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(EXAMPLES))
    refine = sys.modules["gsba.pipeline.refine"].refine
    monkeypatch.setattr(
        "gsba.refine", lambda *given, **more: refine(*given, SETTINGS, **more), raising=False
    )


@pytest.mark.slow
def test_frames_of_equisolid_lenses_are_refined(tmp_path: Path) -> None:
    lens_projection = import_module("lens_projection")
    middle = (SIZE / 2, SIZE / 2)
    own = lens_projection.EquisolidProjection(SIZE, SIZE, FOCAL, middle)
    render(tmp_path / "walk", 2, own, "equisolid")
    given = tmp_path / "walk/raw", tmp_path / "walk/slam0.tum", tmp_path / "walk/calibration.json"
    result = lens_projection.main(*given, tmp_path / "run")
    truth = read_trajectory(tmp_path / "walk/truth.tum")
    errors = evaluate(read_trajectory(tmp_path / "run/trajectory.tum"), truth)
    camera = result.report["camera"]
    assert errors.ate.rmse < 0.004
    assert errors.scale * camera["baseline"] == pytest.approx(distance(2), rel=0.02)


def test_an_equisolid_calibration_is_fitted_to_a_hundredth_pixel(tmp_path: Path) -> None:
    lens_projection = import_module("lens_projection")
    own = lens_projection.EquisolidProjection(SIZE, SIZE, FOCAL, (SIZE / 2, SIZE / 2))
    axes = np.array([[0.0, 0, 1], [0, 0, -1]])
    write_calibration(tmp_path / "c.json", ring(2), axes, own, "equisolid")
    front, _ = read_calibration(tmp_path / "c.json")
    angles = np.deg2rad(np.linspace(0, 95, 50))
    rays = np.stack([np.sin(angles), 0 * angles, np.cos(angles)], axis=1)
    np.testing.assert_allclose(project(front, rays), own.project(rays), atol=0.01)
    write_calibration(tmp_path / "c.json", ring(2), axes, own, "wavy")
    with pytest.raises(GsbaError, match="its model is 'wavy', which is none of kannala-brandt"):
        read_calibration(tmp_path / "c.json")
