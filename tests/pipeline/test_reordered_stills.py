"""What numbers frames follows them into the order that a search has found."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from walk_on_earth import geodetic_of

from gsba.bundle.gps_factors import GpsFactors
from gsba.config import RefineSettings
from gsba.masks import merging
from gsba.pipeline import frontend, tour
from gsba.pipeline.refine import Start, _begin, _without_distractors
from gsba.pipeline.run import Evidence, Journal
from gsba.store.store import RunStore
from gsba.types import Counts, FrameSet, PictureFormat

NAMES, FOUND = ("a", "b", "c", "d", "e"), np.array([3, 0, 4, 1, 2])


@pytest.fixture
def stills(tmp_path: Path) -> FrameSet:
    paths = tuple((tmp_path / f"{name}.png",) for name in NAMES)
    for (path,) in paths:
        cv2.imwrite(str(path), np.zeros((32, 64), np.uint8))
    kind = PictureFormat("erp", 64, 32, ())
    return FrameSet(NAMES, paths, np.arange(5.0), (None,) * 5, (kind,), timed=False)


@pytest.fixture(autouse=True)
def _order_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    def known(store: RunStore, frames: FrameSet, settings: RefineSettings) -> FrameSet:
        return replace(frames.taken(FOUND), timestamps=np.arange(5.0))

    monkeypatch.setattr(tour, "in_known_order", known)


def test_fixes_by_name_stay_with_their_stills(stills: FrameSet, tmp_path: Path) -> None:
    metres = np.random.default_rng(0).normal(0, 30, (5, 3))
    rows = [
        f"{name},{latitude:.9f},{longitude:.9f},{altitude:.4f}"
        for name, (latitude, longitude, altitude) in zip(NAMES, geodetic_of(metres), strict=True)
    ]
    table = tmp_path / "gps.csv"
    table.write_text("\n".join(["name,latitude,longitude,altitude", *rows]))
    tree = {"factors": ("bearing", "gps"), "gps": {"file": str(table)}}
    settings = RefineSettings.model_validate(tree)
    start = Start.of(stills, Evidence(), settings)
    with RunStore(tmp_path / "run", {"frames": tmp_path}) as store:
        run = _begin(store, settings, merging.choose(merging.NONE), start)
    assert run.frames.names == tuple(NAMES[f] for f in FOUND)
    (before,), (after,) = start.evidence.families, run.evidence.families
    assert isinstance(before, GpsFactors) and isinstance(after, GpsFactors)
    np.testing.assert_allclose(after.fixes.positions, before.fixes.positions[FOUND])


def test_masks_of_a_first_solution_are_of_stills_in_the_order_given(
    stills: FrameSet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """So that the search that follows judges the order given, not one that was found before."""

    def after(
        store: RunStore, frames: FrameSet, solved: object, stage: str
    ) -> tuple[FrameSet, Counts]:
        masks = tuple(tmp_path / f"{name}_mask.png" for name in frames.names)
        return replace(frames, mask_paths=masks), Counts(5, 5, "frames")

    monkeypatch.setattr(merging, "after", after)
    monkeypatch.setattr(frontend, "extract", lambda run: run)
    monkeypatch.setitem(_without_distractors.__globals__, "solve", lambda run: solved)
    solved = SimpleNamespace(prior=SimpleNamespace(turning_only=False), solution=None)
    start = Start.of(stills, Evidence(), RefineSettings())
    with RunStore(tmp_path / "run", {"frames": tmp_path}) as store:
        masked = _without_distractors(store, RefineSettings(), start, Journal())
    assert masked.names == NAMES and masked.timestamps.tolist() == stills.timestamps.tolist()
    assert masked.mask_paths == tuple(tmp_path / f"{name}_mask.png" for name in NAMES)
