"""Settings files and overrides: round trip, and one clear line for what is wrong."""

import re
from enum import StrEnum
from pathlib import Path
from typing import Literal

import pytest
from pydantic import BaseModel, ConfigDict, Field, model_validator
from refusals import refused

from gsba import config_file
from gsba.cli.splat import splat_settings
from gsba.config import CameraSettings, RefineSettings
from gsba.config_file import PRESETS, load_config, to_toml
from gsba.log import GsbaError
from gsba.store.finished import load_run

CONFIGS = sorted(PRESETS.glob("*.toml"))


class _Mode(StrEnum):
    FAST = "fast"
    EXACT = "exact"


class _Stage(BaseModel):
    """A stage with every kind of setting.

    More words that stay out of the file.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
    size: int | None = Field(512, ge=64, le=4096)
    ratio: float = Field(1e-6, gt=0, lt=1)
    on: bool = True
    mode: _Mode = _Mode.FAST
    factors: tuple[Literal["bearing", "reprojection"], ...] = ("bearing",)
    label: str = 'a "b" \\ é\n'
    span: tuple[float, float] = (0.0, 1.0)

    @model_validator(mode="after")
    def _ordered(self) -> "_Stage":
        if self.span[0] >= self.span[1]:
            raise ValueError("span must start before it ends")
        return self


class _Outer(BaseModel):
    """Stages of stages."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    inner: _Stage = _Stage()  # type: ignore[call-arg]


class _Everything(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")
    stage: _Stage = _Stage()  # type: ignore[call-arg]
    outer: _Outer = _Outer()
    seed: int = 0


@pytest.fixture
def everything(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(config_file, "RefineSettings", _Everything)


def test_a_table_keeps_what_an_override_leaves_unsaid(tmp_path: Path) -> None:
    expected = RefineSettings().pairs.model_copy(update={"window": 8})
    assert load_config(None, ["pairs.window=8"]).pairs == expected
    path = _written(tmp_path, "[pairs]\nwindow = 8\n")
    assert load_config(path).pairs == expected


def _written(folder: Path, text: str) -> Path:
    path = folder / "settings.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_defaults_need_no_file() -> None:
    assert load_config() == RefineSettings()


def test_resolved_settings_round_trip(tmp_path: Path) -> None:
    settings = load_config(None, ["features.max_per_face=321", "seed=7"])
    assert (settings.features.max_per_face, settings.seed) == (321, 7)
    assert load_config(_written(tmp_path, to_toml(settings))) == settings


@pytest.mark.usefixtures("everything")
def test_every_kind_of_setting_round_trips(tmp_path: Path) -> None:
    overrides = ["stage.size=none", "outer.inner.mode=exact", "outer.inner.on=false"]
    overrides += ['stage.factors=["reprojection", "bearing"]', "stage.ratio=2.5e-7"]
    settings = load_config(None, overrides)
    assert settings.stage.size is None and settings.outer.inner.mode is _Mode.EXACT  # type: ignore
    assert settings.stage.factors == ("reprojection", "bearing")  # type: ignore
    assert load_config(_written(tmp_path, to_toml(settings))) == settings


def test_overrides_win_over_the_file(tmp_path: Path) -> None:
    path = _written(tmp_path, "[features]\nmax_per_face = 100\ncontrast_threshold = 0.5\n")
    settings = load_config(path, ["features.max_per_face=200"])
    assert (settings.features.max_per_face, settings.features.contrast_threshold) == (200, 0.5)


@pytest.mark.usefixtures("everything")
@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("stage.sise=1", "--set: unknown setting stage.sise; did you mean size?"),
        ("zzz.x=1", "--set: unknown setting zzz; known: stage, outer, seed"),
        ("outer.inner.zzz=1", "unknown setting outer.inner.zzz; known: size, ratio"),
        ("stage.size=3", "setting stage.size = 3 is not allowed: use an integer >= 64 and <= 4096"),
        ("stage.size=x", 'setting stage.size = "x" is not allowed: use an integer'),
        ("stage.ratio=1", "setting stage.ratio = 1 is not allowed: use a number > 0 and < 1"),
        ("stage.ratio=nan", "setting stage.ratio = nan is not allowed"),
        ("stage.on=perhaps", "use true or false"),
        ("outer.inner.mode=slow", 'use one of "fast", "exact"'),
        ('stage.factors=["x"]', 'use a list of one of "bearing", "reprojection"'),
        ("stage.span=[2, 1]", "settings stage: span must start before it ends"),
        ("stage=1", "stage is a table of settings (size, "),
        ("seed.x=1", "seed is a value, not a table"),
        ("seed", "--set seed: write stage.key=value"),
        ("=1", "--set =1: write stage.key=value"),
    ],
)
def test_wrong_settings_are_one_clear_line(override: str, message: str) -> None:
    refused(re.escape(message), load_config, None, [override])


def test_a_path_may_be_a_text(tmp_path: Path) -> None:
    assert load_config("fast") == load_config(Path("fast"))
    refused("overrides: give a list", load_config, None, "seed=1")
    refused("is not a gsba run", load_run, str(tmp_path))


def test_unusable_files_are_one_clear_line(tmp_path: Path) -> None:
    refused("cannot read settings", load_config, tmp_path / "missing.toml")
    refused("cannot read settings", load_config, tmp_path)
    refused("not valid TOML", load_config, _written(tmp_path, "[features\n"))
    with pytest.raises(GsbaError, match=r"settings.toml: unknown setting features\.nope"):
        load_config(_written(tmp_path, "[features]\nnope = 1\n"))


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_shipped_configs_load_and_change_something(path: Path) -> None:
    assert load_config(path) != RefineSettings()


def test_configs_are_shipped() -> None:
    assert CONFIGS


def test_images_that_a_format_has_no_place_for_are_refused_early() -> None:
    with pytest.raises(GsbaError, match=r"panorama goes with .* tum, not with colmap$"):
        load_config(None, ("export.images=panorama",))
    fitting = 'export.formats=["colmap-erp","tum"]'
    assert load_config(None, ("export.images=panorama", fitting)).export.images == "panorama"


@pytest.mark.parametrize("iterations", ["0", "10000001", "1" + 20 * "0"])
def test_no_training_takes_for_ever(iterations: str) -> None:
    with pytest.raises(GsbaError, match=r"--iterations \d+: Input should be (less|greater)"):
        splat_settings(int(iterations), None, "cpu")


def test_frames_without_times_keep_the_distance_between_the_lenses() -> None:
    """By which a radius of stitching that is given in metres is one in map units."""
    camera = CameraSettings(name="insta360-x5", stitch_radius_m=2.0)
    untimed = camera.untimed()
    assert camera.readout() and untimed.readout() is None
    assert untimed.inverse_stitch_radius(0.5) == camera.inverse_stitch_radius(0.5) == 0.016
    assert CameraSettings(readout_ms=9.0).untimed() == CameraSettings()
