"""Places by noisy fixes: standard deviations that hold, and refusals where fixes say nothing."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from lasting_errors import SIGMAS_M, fixes_at, lasting_errors
from scipy.spatial.transform import Rotation
from walk_on_earth import frame_set, geodetic_of, walk_result

from gsba.config import GpsSettings, PlacementSettings
from gsba.log import GsbaError
from gsba.placement.gps_fit import GpsFit, fit_fixes
from gsba.placement.placement import Placement, place
from gsba.similarity import Sim3
from gsba.types import FrameSet, Reconstruction

UP_SIGMA = np.deg2rad(0.2)
DRAWS = 60


def _walk(num: int, metres: float) -> np.ndarray:
    t = np.linspace(0, 1, num)
    return metres * np.column_stack([t, 0.3 * np.sin(4 * t), 0.02 * np.cos(9 * t)])


def _times(true: np.ndarray) -> np.ndarray:
    steps = np.linalg.norm(np.diff(true, axis=0, prepend=true[:1]), axis=1)
    return np.cumsum(steps) / 1.2  # m/s


def _errors(
    fit: GpsFit, level_from_map: Sim3, positions: np.ndarray, true: np.ndarray
) -> list[float]:
    """Errors of scale, heading, tilt and position in their standard deviations."""
    turn = level_from_map.rotation @ fit.similarity.rotation.T
    turned = Rotation.from_matrix(turn).as_rotvec()
    tilt = np.linalg.norm(turned[:2]) / np.sqrt(np.trace(fit.covariance[1:3, 1:3]))
    off = (fit.similarity.points(positions) - true) / fit.position_sigmas(positions)
    return [
        np.log(level_from_map.scale / fit.similarity.scale) / fit.scale_sigma,
        turned[2] / fit.heading_sigma,
        float(tilt),
        float(np.sqrt(np.mean(off**2))),
    ]


@pytest.mark.parametrize(
    ("num", "metres", "up", "scale_sigma", "tau", "wild"),
    [
        (100, 250.0, False, None, 60.0, 0.0),
        (100, 250.0, True, None, 60.0, 0.1),
        (400, 600.0, True, None, 60.0, 0.0),
        (8, 60.0, False, None, 60.0, 0.0),
        (5, 40.0, True, None, 60.0, 0.0),
        (5, 40.0, True, 0.03, 60.0, 0.0),
        (100, 250.0, True, None, 40.0, 0.0),
        (100, 250.0, True, None, 100.0, 0.0),
    ],
)
def test_errors_are_as_standard_deviations_say(
    num: int, metres: float, up: bool, scale_sigma: float | None, tau: float, wild: float
) -> None:
    """Over walks long and short, up known or not, also where errors last 40 or 100 s, not 60."""
    rng, true, found = np.random.default_rng(num), _walk(num, metres), []
    times = _times(true)
    for _ in range(DRAWS):
        turn = Rotation.from_rotvec(rng.normal(0, 1, 3))
        if up:
            turn = Rotation.from_rotvec([*rng.normal(0, UP_SIGMA, 2), 0])
            turn = Rotation.from_rotvec([0, 0, rng.uniform(-3, 3)]) * turn
        level_from_map = Sim3(float(np.exp(rng.normal())), turn.as_matrix(), rng.normal(0, 50, 3))
        positions = level_from_map.points_back(true)
        fixes = fixes_at(true + lasting_errors(times, rng, tau), times)
        false = rng.random(num) < wild
        fixes.positions[false] += 60 * rng.choice([-1, 1], (false.sum(), 3))
        scale = None
        if scale_sigma is not None:
            of_lenses = level_from_map.scale * np.exp(rng.normal(0, scale_sigma))
            scale = of_lenses, scale_sigma * of_lenses
        fit = fit_fixes(positions, fixes, UP_SIGMA if up else None, scale)
        assert not fit.used[false].any()
        found.append(_errors(fit, level_from_map, positions, true))
    rms = np.sqrt(np.mean(np.square(found), axis=0))
    assert np.all(rms > 0.7) and np.all(rms < 1.5), rms


def test_many_fixes_do_not_average_out_errors_that_last() -> None:
    true = _walk(1000, 60.0)
    times = _times(true)
    fit = fit_fixes(true, fixes_at(true.copy(), times), UP_SIGMA)
    east = fit.position_sigmas(true.mean(axis=0)[None])[0, 0]
    assert 2 < east < SIGMAS_M[0]


def test_a_known_scale_weighs_with_the_fixes() -> None:
    true = _walk(5, 40.0)
    fixes = fixes_at(1.2 * true, _times(true))  # as if the walk were longer
    alone, beside = (fit_fixes(true, fixes, UP_SIGMA, scale) for scale in (None, (1.0, 0.01)))
    assert alone.similarity.scale == pytest.approx(1.2)
    assert 1 < beside.similarity.scale < 1.02 and beside.scale_sigma < 0.011


def _table(path: Path, frames: FrameSet, level: np.ndarray, more: str = "") -> str:
    header = "name,lat,lon,alt" + (",hdop" if more else "")
    rows = [
        f"{name},{lat:.12f},{lon:.12f},{alt:.6f}{more}"
        for name, (lat, lon, alt) in zip(frames.names, geodetic_of(level), strict=True)
    ]
    path.write_text("\n".join([header, *rows]) + "\n")
    return str(path)


def _result(positions: np.ndarray) -> Reconstruction:
    base = walk_result(len(positions))
    poses = base.world_T_rigs.copy()
    poses[:, :3, 3] = positions
    return dataclasses.replace(base, world_T_rigs=poses)


@pytest.fixture
def upright(monkeypatch: pytest.MonkeyPatch) -> PlacementSettings:
    """Settings under which the run's -y is up, by 100 vertical edges."""
    known = Placement(up="-y", grounds={"gravity": {"vertical_edges": 100}})
    monkeypatch.setattr("gsba.placement.placement._upright", lambda *_: known)
    return PlacementSettings(up="auto")


Y_DOWN = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # level = positions @ Y_DOWN.T


def test_standard_deviations_are_stated(tmp_path: Path, upright: PlacementSettings) -> None:
    frames, true = frame_set(40), _walk(40, 80.0)
    file = _table(tmp_path / "gps.csv", frames, true)
    settings = upright.model_copy(update={"gps": file})
    said = place(_result(true @ Y_DOWN), frames, settings).grounds["gps"]
    assert 0.02 < said["scale_sigma"] < 0.1 and 1 < said["heading_sigma_deg"] < 5
    assert said["tilt_sigma_deg"] == pytest.approx(0.2)
    assert np.all(np.array(said["position_sigma_m"]) > 2)
    better = GpsSettings(sigma_m=0.05, sigma_up_m=0.1)
    found = place(_result(true @ Y_DOWN), frames, settings, gps=better).grounds["gps"]
    assert found["scale_sigma"] == pytest.approx(said["scale_sigma"] / 60, rel=0.1)
    worse = _table(tmp_path / "dop.csv", frames, true, ",4.0")
    settings = upright.model_copy(update={"gps": worse})
    found = place(_result(true @ Y_DOWN), frames, settings).grounds["gps"]
    assert found["scale_sigma"] == pytest.approx(4 * said["scale_sigma"], rel=0.01)


def test_what_fixes_leave_open_is_refused(tmp_path: Path, upright: PlacementSettings) -> None:
    frames, true = frame_set(40), _walk(40, 80.0)
    poor = GpsSettings(sigma_m=60.0, sigma_up_m=100.0)
    file = _table(tmp_path / "gps.csv", frames, true)
    settings = upright.model_copy(update={"gps": file})
    with pytest.raises(GsbaError, match=r"determine the scale only to .* % .*: add --scale lens"):
        place(_result(true @ Y_DOWN), frames, settings, gps=poor)
    known = dataclasses.replace(_result(true @ Y_DOWN), lens_baseline=(0.032, 3e-4))
    lens = settings.model_copy(update={"length": "lens"})
    with pytest.raises(GsbaError, match=r"determine north only to .* degrees"):
        place(known, frames, lens, (0.032, 3e-4), poor)
    placed = place(known, frames, lens, (0.032, 3e-4))
    assert placed.similarity.scale == pytest.approx(1, rel=0.01)
    assert placed.grounds["gps"]["scale_sigma"] < placed.grounds["lens"]["scale_sigma"]
    flat = true * [1, 1, 0] + [0, 0, 1.5]
    file = _table(tmp_path / "flat.csv", frames, flat)
    low = GpsSettings(sigma_up_m=150.0)
    with pytest.raises(
        GsbaError, match=r"determine the vertical only to .* degrees: add --up auto"
    ):
        place(_result(flat), frames, PlacementSettings(gps=file), gps=low)


def test_a_straight_path_is_placed_where_up_is_known(
    tmp_path: Path, upright: PlacementSettings
) -> None:
    frames = frame_set(40)
    true = np.column_stack([np.linspace(0, 90, 40), np.zeros(40), np.full(40, 1.5)])
    file = _table(tmp_path / "gps.csv", frames, true)
    settings = upright.model_copy(update={"gps": file})
    placed = place(_result(0.5 * true @ Y_DOWN), frames, settings)
    assert placed.similarity.scale == pytest.approx(2)
    # North at the middle of the walk is 8e-6 rad from north at the origin of the fixes.
    np.testing.assert_allclose(placed.similarity.rotation, Y_DOWN, atol=2e-5)


def test_swapped_columns_turn_the_run_upside_down(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A level walk fits a mirror image upside down: how the camera was held tells."""
    frames, true = frame_set(40), _walk(40, 80.0)
    result = _result(true @ Y_DOWN)
    result.world_T_rigs[:, :3, :3] = np.eye(3)
    file = Path(_table(tmp_path / "gps.csv", frames, true))
    place(result, frames, PlacementSettings(gps=str(file)))
    assert not caplog.records
    file.write_text(file.read_text().replace("lat,lon", "lon,lat"))
    place(result, frames, PlacementSettings(gps=str(file)))
    assert "the placed run is upside down" in caplog.text


def test_altitudes_that_jump_tilt_the_run(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, upright: PlacementSettings
) -> None:
    """By more than its sigma promises: how the camera was held tells."""
    frames, true = frame_set(40), _walk(40, 80.0)
    result = _result(true @ Y_DOWN)
    result.world_T_rigs[:, :3, :3] = np.eye(3)
    jumped = true + np.outer(np.arange(40) > 24, [0, 0, 47.0])
    file = _table(tmp_path / "gps.csv", frames, jumped)
    placed = place(result, frames, PlacementSettings(gps=file))
    turned = placed.similarity.rotation @ Y_DOWN.T
    assert np.degrees(np.arccos(turned[2, 2])) > 3 * placed.grounds["gps"]["tilt_sigma_deg"]
    assert "the cameras lean by" in caplog.text
    caplog.clear()
    place(result, frames, upright.model_copy(update={"gps": file}))
    assert not caplog.records


def test_the_date_line_is_no_jump(tmp_path: Path, upright: PlacementSettings) -> None:
    frames, true = frame_set(40), _walk(40, 80.0)
    rows = ["name,lat,lon,alt"]
    for name, (east, north, up) in zip(frames.names, true, strict=True):
        longitude = 179.9997 + east / 111_319.49
        longitude -= 360 if longitude > 180 else 0
        rows.append(f"{name},{north / 110_574.28:.12f},{longitude:.12f},{up:.6f}")
    (tmp_path / "gps.csv").write_text("\n".join(rows))
    settings = upright.model_copy(update={"gps": str(tmp_path / "gps.csv")})
    placed = place(_result(true @ Y_DOWN), frames, settings)
    assert placed.similarity.scale == pytest.approx(1, rel=1e-4)
    assert placed.origin is not None and abs(placed.origin[1]) == pytest.approx(180, abs=1e-3)
