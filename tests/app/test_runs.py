"""Contents of run folders that the page shows while a run goes on."""

import json
from pathlib import Path
from typing import Any

import export_scene as scene
import numpy as np
import pytest
from plain_records import observing

from gsba.pipeline.stage_titles import LENS_CENTRES, READOUTS, RECONSTRUCTION, is_one_of, title_of
from gsba.store.records import save_record
from tests.tiny_run import Case

pytest.importorskip("starlette")

from gsba.app.runs import brief_facts, camera_so_far, finished_map, overview


def test_the_camera_is_told_as_soon_as_its_stage_has_ended(case: Case) -> None:
    stages = case.result.report["stages"]
    assert stages[0]["title"] == "find what turns with the camera"
    names = [stage["name"] for stage in stages]
    first = next(n for n, name in enumerate(names) if is_one_of(name, LENS_CENTRES))
    assert camera_so_far(case.out, names[:first]) == []
    (line,) = camera_so_far(case.out, names[: first + 1])
    assert line == f"two lenses were not found: {case.result.report['camera']['reason']}"


def test_the_map_is_that_of_the_run(case: Case) -> None:
    found = finished_map(case.out)
    assert found["stage"] == RECONSTRUCTION
    assert len(found["path"]) == len(case.result.frames)


@pytest.mark.parametrize("pattern", [*LENS_CENTRES, *READOUTS, RECONSTRUCTION])
def test_stages_that_the_page_looks_for_are_stages(pattern: str) -> None:
    name = pattern.replace("#", "1").replace("+", "0")
    assert title_of(name) != name
    assert is_one_of(name, [pattern]) and is_one_of(f"again_{name}@upper", [pattern])
    assert not is_one_of(f"{name}x", [pattern])


@pytest.mark.parametrize(
    ("verdict", "level", "sentence", "reasons"),
    [
        (
            {
                "level": "do not train",
                "sentence": "do not train: 3 of 9 frames are in the map",
                "reasons": [{"line": "frame 3: no match; film slower"}, 5],
            },
            "stop",
            "3 of 9 frames are in the map",
            ["frame 3: no match; film slower"],
        ),
        ({"level": "good to train", "sentence": "fine"}, "good", "fine", []),
        ({"level": "stop", "sentence": "off"}, "stop", "off", []),
        ({"level": "of a later version", "sentence": "so so"}, "look", "so so", []),
    ],
)
def test_the_verdict_is_that_of_the_report(
    tmp_path: Path, verdict: dict[str, Any], level: str, sentence: str, reasons: list[str]
) -> None:
    summary = {"refined": 9, "exported": 10, "frames": 11, "fetched": 1, "frames_fetched": 2}
    report = {"summary": summary, "verdict": verdict}
    (tmp_path / "report.json").write_text(json.dumps(report))
    shown = overview(tmp_path)["verdict"]
    assert shown == {"level": level, "sentence": sentence, "reasons": reasons, "doubted": []}
    apart = "1 with the pose of the trajectory file, 1 more strengthened the map, and datasets skip"
    counts = f"8 of 9 frames refined ({apart} them)"
    assert brief_facts(tmp_path) == {"verdict": level, "refined": counts}
    for nothing in ({}, {"level": "good"}, None, "good", []):
        (tmp_path / "report.json").write_text(json.dumps(report | {"verdict": nothing}))
        assert overview(tmp_path)["verdict"] is None


def test_the_map_from_above_has_places_and_points_of_the_largest_map_alone(tmp_path: Path) -> None:
    whole = scene.reconstruction()
    maps = np.array([0, 0, 1, -1, 0, 0, 1, 0, 0], np.int32)
    seen = maps[whole.observation_points] == maps[whole.observation_frames]
    at = whole.world_T_rigs[:, :3, 3]
    result = observing(whole, seen, components=maps, points_world=at)
    (tmp_path / "stages").mkdir()
    save_record(tmp_path / "stages" / "reconstruction.npz", result, {})
    found = finished_map(tmp_path)
    assert [place is not None for place in found["path"]] == (maps == 0).tolist()
    assert len(found["points"]) == len(found["colors"]) == np.count_nonzero(maps == 0)
