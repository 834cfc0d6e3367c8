"""Contents of run folders that the page shows while a run goes on."""

import pytest

from gsba.pipeline.stage_titles import LENS_CENTRES, READOUTS, RECONSTRUCTION, is_one_of, title_of
from tests.tiny_run import Case

pytest.importorskip("starlette")


def test_the_camera_is_told_as_soon_as_its_stage_has_ended(case: Case) -> None:
    from gsba.app.runs import camera_so_far

    names = [stage["name"] for stage in case.result.report["stages"]]
    first = next(n for n, name in enumerate(names) if is_one_of(name, LENS_CENTRES))
    assert camera_so_far(case.out, names[:first]) == []
    (line,) = camera_so_far(case.out, names[: first + 1])
    assert line == f"two lenses were not found: {case.result.report['camera']['reason']}"


def test_the_map_is_that_of_the_run(case: Case) -> None:
    from gsba.app.runs import finished_map

    found = finished_map(case.out)
    assert found["stage"] == RECONSTRUCTION
    assert len(found["path"]) == len(case.result.frames)


@pytest.mark.parametrize("pattern", [*LENS_CENTRES, *READOUTS, RECONSTRUCTION])
def test_stages_that_the_page_looks_for_are_stages(pattern: str) -> None:
    name = pattern.replace("#", "1").replace("+", "0")
    assert title_of(name) != name
    assert is_one_of(name, [pattern]) and is_one_of(f"again_{name}@upper", [pattern])
    assert not is_one_of(f"{name}x", [pattern])
