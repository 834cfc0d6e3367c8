"""Families that packages provide, by their entry points."""

import sys
from importlib.metadata import EntryPoint
from types import SimpleNamespace

import gtsam
import numpy as np
import pytest
from refusals import refused

from gsba import Family, MapSnapshot
from gsba.bundle.families import Families
from gsba.config_file import load_config
from gsba.log import GsbaError
from gsba.pipeline import inputs
from gsba.pipeline.outputs import of_family
from gsba.types import Solution


class _Barometer(Family):
    name = "barometer"

    def __init__(self, frames: object, argument: str | None) -> None:
        self.frames, self.digest = frames, str(argument)

    def graph(self, snapshot: MapSnapshot) -> gtsam.NonlinearFactorGraph:
        return gtsam.NonlinearFactorGraph()


@pytest.fixture(autouse=True)
def _installed(monkeypatch: pytest.MonkeyPatch) -> None:
    module = SimpleNamespace(make=_Barometer)
    monkeypatch.setitem(sys.modules, "package_of_barometer", module)  # type: ignore[arg-type]
    points = [
        EntryPoint("barometer", "package_of_barometer:make", "gsba.families"),
        EntryPoint("broken", "package_that_is_not_there:make", "gsba.families"),
    ]
    monkeypatch.setattr("gsba.config.entry_points", lambda group: points)


def test_a_package_s_family_is_made_from_frames_and_its_argument() -> None:
    settings = load_config(None, ['factors=["bearing", "barometer:heights.csv"]'])
    frames = object()
    (family,) = inputs.families_of(frames, settings)  # type: ignore[arg-type]
    assert isinstance(family, _Barometer)
    assert (family.frames, family.digest) == (frames, "heights.csv")
    settings = load_config(None, ['factors=["bearing", "barometer"]'])
    assert inputs.families_of(frames, settings)[0].digest == "None"  # type: ignore[arg-type]


def test_what_is_not_installed_is_refused_with_what_is() -> None:
    with pytest.raises(
        GsbaError, match=r'"list" is not installed; installed are "bearing".*"barometer"'
    ):
        load_config(None, ['factors=["bearing", "list"]'])


def test_a_package_that_does_not_load_is_named() -> None:
    settings = load_config(None, ['factors=["bearing", "broken"]'])
    with pytest.raises(GsbaError, match="family broken: its package cannot be loaded"):
        inputs.families_of(object(), settings)  # type: ignore[arg-type]


def test_a_report_that_json_cannot_hold_is_the_family_s() -> None:
    class Telling(_Barometer):
        def report(self, snapshot: MapSnapshot) -> dict:
            return {"bias": snapshot.variables}

    frame = Families((Telling(None, None),), ("0",), np.zeros(1))
    snapshot = frame.snapshot(Solution.without_points(np.eye(4)[None]))
    refused(r"family barometer: report.json cannot hold", of_family, *frame.members, snapshot)
