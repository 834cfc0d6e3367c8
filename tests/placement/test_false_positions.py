"""False positions: those that are no fixes, minorities that are left out, majorities refused."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from walk_on_earth import frame_set, geodetic_of, level_metres, walk_result

from gsba.config import PlacementSettings
from gsba.geometry import pose
from gsba.log import GsbaError
from gsba.placement.frame_fixes import fixes_of_frames
from gsba.placement.placement import Placement, place
from gsba.similarity import Sim3
from gsba.trajectory.files import write_tum
from gsba.types import Trajectory

NUM = 40
METRES_PER_UNIT = 2.5 / 0.21  # of the walk: 75 m long
LEVEL = 2.5 * level_metres(walk_result())


def _table(path: Path, geodetic: np.ndarray) -> str:
    rows = [f"{0.5 * n},{a:.8f},{o:.8f},{h:.2f}" for n, (a, o, h) in enumerate(geodetic)]
    path.write_text("\n".join(["timestamp,latitude,longitude,altitude", *rows]) + "\n")
    return str(path)


def _noisy(seed: int = 1) -> np.ndarray:
    return geodetic_of(LEVEL + np.random.default_rng(seed).normal(0, [1.0, 1, 2], (NUM, 3)))


@pytest.mark.parametrize("num", [10, 22])
@pytest.mark.parametrize("kind", ["zeros", "repeated"])
def test_a_receiver_without_a_lock_has_no_fixes(tmp_path: Path, kind: str, num: int) -> None:
    """It writes 0, 0, or its last place, 1.5 km off, for most of the walk."""
    geodetic = _noisy()
    geodetic[:num] = 0 if kind == "zeros" else geodetic[0] + [0.01, 0.013, 0]
    file = _table(tmp_path / "gps.csv", geodetic)
    placed = place(walk_result(), frame_set(NUM), PlacementSettings(gps=file))
    said = placed.grounds["gps"]
    assert abs(placed.similarity.scale - METRES_PER_UNIT) < 4 * said["scale_sigma"]
    assert placed.similarity.scale == pytest.approx(METRES_PER_UNIT, rel=0.15)
    assert said["rmse_m"] < 4 and said["fixes"] - said["outliers"] == NUM - num


def test_a_receiver_that_never_had_a_lock_is_refused(tmp_path: Path) -> None:
    file = _table(tmp_path / "gps.csv", np.zeros((NUM, 3)))
    with pytest.raises(GsbaError, match="all 40 positions are latitude 0, longitude 0"):
        fixes_of_frames(file, frame_set(NUM))


@pytest.mark.parametrize("scatter", [3.0, 400.0])
def test_a_false_majority_is_refused_by_name(tmp_path: Path, scatter: float) -> None:
    level, rng = LEVEL.copy(), np.random.default_rng(2)
    level[:26] = [1100, 1000, 0] + rng.normal(0, scatter, (26, 3)) * [1, 1, 0.1]
    file = _table(tmp_path / "gps.csv", geodetic_of(level))
    with pytest.raises(GsbaError, match=r"gps\.csv: .*(contradict the run|not correlated)") as said:
        place(walk_result(), frame_set(NUM), PlacementSettings(gps=file))
    assert "contradict" not in str(said.value) or "frame_0000 (0.000 s)" in str(said.value)


def test_a_minority_of_any_kind_is_left_out(tmp_path: Path) -> None:
    level = LEVEL + np.random.default_rng(3).normal(0, [1.0, 1, 2], (NUM, 3))
    level[:15] += [1100, 1000, 0]
    file = _table(tmp_path / "gps.csv", geodetic_of(level))
    placed = place(walk_result(), frame_set(NUM), PlacementSettings(gps=file))
    assert placed.grounds["gps"]["outliers"] == 15
    assert placed.similarity.scale == pytest.approx(METRES_PER_UNIT, rel=0.1)


def test_lenses_and_gps_of_different_scales_are_refused(tmp_path: Path) -> None:
    file = _table(tmp_path / "gps.csv", _noisy())
    settings = PlacementSettings(gps=file, length="lens")
    for scale, fits in ((METRES_PER_UNIT, True), (2 * METRES_PER_UNIT, False)):
        result = dataclasses.replace(walk_result(), lens_baseline=(0.032 / scale, 1e-5))
        if fits:
            placed = place(result, frame_set(NUM), settings, (0.032, 3e-4))
            assert placed.similarity.scale == pytest.approx(METRES_PER_UNIT, rel=0.03)
        else:
            with pytest.raises(GsbaError, match=r"give .* m per map unit .*, the lenses 23\.8"):
                place(result, frame_set(NUM), settings, (0.032, 3e-4))


@pytest.mark.parametrize("false", [10, 25])
def test_true_poses_of_which_most_are_false_are_refused(tmp_path: Path, false: int) -> None:
    result, frames = walk_result(), frame_set(NUM)
    true = Placement(Sim3(METRES_PER_UNIT)).apply(result).world_T_rigs
    true[:false, :3, 3] = true[0, :3, 3] + np.random.default_rng(5).normal(0, 200, (false, 3))
    write_tum(tmp_path / "truth.tum", Trajectory(frames.timestamps, true))
    settings = PlacementSettings(align=str(tmp_path / "truth.tum"))
    if 2 * false < NUM:
        placed = place(result, frames, settings)
        assert placed.similarity.scale == pytest.approx(METRES_PER_UNIT)
        assert placed.grounds["align"]["outliers"] == false
        return
    with pytest.raises(GsbaError, match=r"truth\.tum: 2\d of 40 positions contradict the run, by"):
        place(result, frames, settings)


def test_true_poses_of_another_walk_are_refused(tmp_path: Path) -> None:
    """All are wrong, none by much: their median misfit is no measure of what is right."""
    rng, frames = np.random.default_rng(6), frame_set(NUM)
    turns = np.cumsum(rng.normal(0, 0.5, NUM))
    path = np.cumsum(np.column_stack([np.cos(turns), np.sin(turns), np.zeros(NUM)]), axis=0)
    true = pose(Rotation.from_rotvec(rng.normal(0, 1, (NUM, 3))).as_matrix(), path)
    write_tum(tmp_path / "truth.tum", Trajectory(frames.timestamps, true))
    with pytest.raises(GsbaError, match=r"truth\.tum: .*(contradict the run|not correlated)"):
        place(walk_result(), frames, PlacementSettings(align=str(tmp_path / "truth.tum")))
