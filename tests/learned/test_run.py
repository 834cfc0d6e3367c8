"""A run whose keypoints and matches come from `learned`, with stand-ins that need no library."""

import os
import sys
import types
from pathlib import Path

import numpy as np
import pytest
from tiny_run import BARE, Case, computed_stages

from gsba.config import FeatureSettings, RefineSettings
from gsba.evaluate.trajectory import evaluate
from gsba.features.detection import TRAITS, FaceKeypoints, SiftExtractor
from gsba.matching import correspondences
from gsba.photometric import frame_jobs
from gsba.trajectory.files import read_trajectory


class Keypoints:
    """SIFT in the place of a network's keypoints."""

    def __init__(self, settings: FeatureSettings, weights: Path) -> None:
        assert weights.name == "aliked-n16.pth"
        self._sift = SiftExtractor(settings)

    def __call__(self, face_rgb: np.ndarray, mask: np.ndarray | None) -> FaceKeypoints:
        found = self._sift(face_rgb, mask)
        descriptors = found.descriptors.astype(np.float32)
        scores = np.linspace(1, 0, len(descriptors), dtype=np.float32)
        return FaceKeypoints(found.pixels, found.sigmas_px, descriptors, scores)


class Nearest:
    """Mutual nearest neighbours in the place of a network's matches."""

    asked = 0

    def __init__(self, extractor: str, weights: Path) -> None:
        assert (extractor, weights.name) == ("aliked", "aliked_lightglue.pth")

    def __call__(
        self, first: FaceKeypoints, second: FaceKeypoints, size: int
    ) -> tuple[np.ndarray, np.ndarray]:
        assert first.scores is not None and (first.pixels < size).all()
        one, other = (
            f.descriptors / np.linalg.norm(f.descriptors, axis=1, keepdims=True)
            for f in (first, second)
        )
        like = one @ other.T
        rows = np.flatnonzero(like.argmax(axis=0)[like.argmax(axis=1)] == np.arange(len(one)))
        columns = like.argmax(axis=1)[rows]
        Nearest.asked += 1
        return np.column_stack([rows, columns]), like[rows, columns]


@pytest.fixture
def settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> RefineSettings:
    """ALIKED and LightGlue, both replaced by the stand-ins."""
    stub = types.ModuleType("gsba.learned.lightglue")
    stub.LightGlue = Nearest  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "gsba.learned.lightglue", stub)
    monkeypatch.setattr("gsba.learned.extractor.LearnedExtractor", Keypoints)
    for name in ("aliked-n16.pth", "aliked_lightglue.pth"):
        (tmp_path / name).write_bytes(b"weights")
    changes = {
        "features": {"extractor": "aliked", "weights": str(tmp_path), "max_per_face": 200},
        "matching": {"matcher": "lightglue", "weights": str(tmp_path)},
        "patches": {"rounds": 1},
    }
    return RefineSettings.model_validate(BARE.model_dump() | changes)


def test_a_run_uses_both_and_resumes(
    case: Case, settings: RefineSettings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, Nearest.asked = tmp_path / "run", 0
    cut, sizes = frame_jobs.cut, set[int]()

    def cutting(name, greys, hosts, origins, spreads, size, workers):
        sizes.add(size)
        return cut(name, greys, hosts, origins, spreads, size, workers)

    monkeypatch.setattr(frame_jobs, "cut", cutting)
    monkeypatch.setattr(correspondences, "SCARCE_MATCHES", 10_000)  # for search, at neighbours
    result = case.refine(out, settings)
    assert Nearest.asked > 50 and sizes == {TRAITS["aliked"].patch_size}
    before = evaluate(read_trajectory(case.slam), case.truth)
    assert case.errors(out).ate.rmse < before.ate.rmse / 10
    assert result.report["summary"]["refined"] == len(case.truth.timestamps)

    asked = Nearest.asked
    assert computed_stages(case.refine(out, settings)) == [] and Nearest.asked == asked

    weights = tmp_path / "aliked_lightglue.pth"
    os.utime(weights, (1, 1))
    again = computed_stages(case.refine(out, settings))
    assert "neighbours" in again and "features" not in again and Nearest.asked > asked

    consent = settings.features.model_copy(update={"accept_noncommercial": True})
    agreed = settings.model_copy(update={"features": consent})
    assert computed_stages(case.refine(out, agreed)) == []
