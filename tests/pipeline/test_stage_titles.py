"""Titles of stages in the log."""

import pytest

from gsba.pipeline.stage_titles import title_of
from tests.tiny_run import Case


@pytest.mark.parametrize(
    ("name", "title"),
    [
        ("everywhere1", "match known points, pass 1"),
        ("lenses0", "estimate lens centres, round 1"),
        ("calibrated3", "adjust poses and calibrated lenses, matched anew, round 4"),
        ("aligned12_3", "adjust aligned patches, round 12, camera estimate 4"),
        ("first-refined2", "first solution: adjust with known points, pass 2"),
        ("again_axes", "once more: choose lens axes"),
        ("export-colmap", "export colmap"),
        ("unheard-of", "unheard-of"),
    ],
)
def test_titles_count_from_one(name: str, title: str) -> None:
    assert title_of(name) == title


def test_every_stage_of_a_run_has_a_title(case: Case) -> None:
    names = [stage["name"] for stage in case.result.report["stages"]]
    assert len(names) > 15 and [name for name in names if title_of(name) == name] == []
