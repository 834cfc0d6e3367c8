"""Runs with GPS fixes as factors: on the command line, from a table or from tags, and refused."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from command import fails, run_gsba, succeed
from tiny_run import PLAIN, Case, computed_stages
from walk_on_earth import geodetic_of, write_fixes

from gsba.config import RefineSettings
from gsba.evaluate.trajectory import evaluate
from gsba.log import GsbaError
from gsba.trajectory.files import read_trajectory


def _with_gps(file: Path, **options: float) -> RefineSettings:
    tree = PLAIN.model_dump() | {"factors": ("bearing", "gps")}
    return RefineSettings.model_validate(tree | {"gps": {"file": str(file), **options}})


def _table(
    path: Path, case: Case, metres: float, seed: int = 0, shift_s: float = 0.0, stretch: float = 1.0
) -> Path:
    """Fixes of the true positions, blown up to metres and along north, with .3 m of noise."""
    times, upright = case.truth.timestamps, np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    level = metres * case.truth.world_T_rigs[:, :3, 3] @ upright
    level += np.random.default_rng(seed).normal(0, 0.3, level.shape)
    level[:, 1] *= stretch
    return write_fixes(path, times + shift_s, geodetic_of(level))


def _apart(one: Path, other: Path) -> float:
    """RMS of the positions of two runs, once aligned, over the extent of the walk."""
    first, second = (read_trajectory(out / "trajectory.tum") for out in (one, other))
    extent = float(np.linalg.norm(np.ptp(second.world_T_rigs[:, :3, 3], axis=0)))
    return evaluate(first, second).ate.rmse / extent


def test_fixes_hold_a_run_and_are_reported(case: Case, plain_run: Path, tmp_path: Path) -> None:
    table = _table(tmp_path / "gps.csv", case, 30.0)
    out = Path(shutil.copytree(plain_run, tmp_path / "run"))
    result = case.refine(out, _with_gps(table))
    said = json.loads((out / "report.json").read_text())["gps"]
    assert said["taken"] and said["used"] == said["fixes"] == len(case.truth.timestamps)
    assert said["false_fixes"] == [] and said["residual_m"]["most"] < 10
    assert any(note.startswith("GPS held 8 of 8 frames") for note in result.report["notes"])
    # Images know this walk far better: fixes leave it as it is, in the trajectory's world.
    assert _apart(out, plain_run) < 1e-4
    assert case.errors(out).scale == pytest.approx(case.errors(plain_run).scale, rel=1e-3)
    claims = []
    late = _table(tmp_path / "late.csv", case, 30.0, shift_s=1000.0)
    for file, more in ((table, ()), (late, ("--gps-sigma", "0.3", "--gps-offset", "-1000"))):
        folder = tmp_path / f"export{len(more)}"
        command = ["export", out, "--to", "tum", "--out", folder, "--gps", file, *more]
        done = succeed(*command)
        said = json.loads((folder / "transform.json").read_text())
        assert (said["unit"], said["up"]) == ("m", "z")
        place, scale = said["origin"], said["scale"]
        told = f"at latitude {place['latitude']:.5f}, longitude {place['longitude']:.5f}, with "
        assert f"placed by {file} {told}{scale:.4g} m to a map unit" in done.stdout
        claims.append(said["grounds"]["gps"]["scale_sigma"])
    assert claims[1] < 0.2 * claims[0]
    again = case.refine(out, _with_gps(table))
    assert computed_stages(again) == []
    other = case.refine(out, _with_gps(_table(tmp_path / "other.csv", case, 30.0, seed=1)))
    assert "chain" in computed_stages(other) and "features" not in computed_stages(other)


def test_the_command_takes_gps_as_a_family(case: Case, tmp_path: Path) -> None:
    late = _table(tmp_path / "gps.csv", case, 30.0, shift_s=1000.0)
    for source, message in (
        (late, "no overlap in time"),
        (tmp_path / "none.csv", "none.csv: cannot be read"),
        ("exif", "--gps exif: 0 of 8 frames have GPS tags"),
    ):
        command = ["refine", case.frames, case.slam, "--out", tmp_path / "run", "--gps", source]
        fails(run_gsba(*command), message)


def test_positions_elsewhere_have_no_say(case: Case, plain_run: Path, tmp_path: Path) -> None:
    elsewhere = np.random.default_rng(3).normal(0, 2, (len(case.truth.timestamps), 3))
    table, out = tmp_path / "gps.csv", tmp_path / "run"
    write_fixes(table, case.truth.timestamps, geodetic_of(elsewhere))
    report = case.refine(out, _with_gps(table)).report
    assert not report["gps"]["taken"]
    assert any(note.startswith("GPS was not used") for note in report["notes"])
    assert _apart(out, plain_run) < 1e-4


def test_fixes_that_images_contradict_are_left_out(
    case: Case, plain_run: Path, tmp_path: Path
) -> None:
    """Precise by their claim, but stretched: they would bend the map."""
    table = _table(tmp_path / "gps.csv", case, 300.0, stretch=1.1)
    out = Path(shutil.copytree(plain_run, tmp_path / "run"))
    report = case.refine(out, _with_gps(table, sigma_m=0.05, sigma_up_m=0.05)).report
    assert report["gps"] | {"taken": False, "contradicted": True} == report["gps"]
    assert any("would bend the map" in note for note in report["notes"])
    assert _apart(out, plain_run) < 1e-3


def test_settings_name_both_or_none() -> None:
    with pytest.raises(ValueError, match="factors: gps needs positions: pass --gps FILE"):
        RefineSettings.model_validate({"factors": ("bearing", "gps")})
    with pytest.raises(ValueError, match=r"gps\.file is read by the gps factors"):
        RefineSettings.model_validate({"gps": {"file": "walk.gpx"}})


def test_too_few_positions_are_one_line(case: Case, tmp_path: Path) -> None:
    table = _table(tmp_path / "gps.csv", case, 30.0)
    table.write_text("".join(table.read_text().splitlines(keepends=True)[:4]))
    with pytest.raises(GsbaError, match=r"gps.csv: 3 of 8 frames have a position, and 5 are"):
        case.refine(tmp_path / "run", _with_gps(table))
