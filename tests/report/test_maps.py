"""The table of a run's maps, the line that counts frames, and when a run is partial."""

import json
from pathlib import Path

import export_scene as scene
import numpy as np
import pytest
from plain_records import observing

from gsba.config import RefineSettings
from gsba.report.maps import MapSummary, format_outcome, is_partial, summarize_maps
from gsba.report.report import Findings, StageLog, build_report
from gsba.types import CoarsePoses, PoseStatus, Reconstruction

COMPONENTS = np.array([0, 0, 1, 2, 0, 0, 1, 0, 3], np.int32)  # two maps, and two frames alone


def _in_maps(components: np.ndarray = COMPONENTS) -> Reconstruction:
    """The scene with every point seen in one map alone: point j in that of frame j."""
    whole = scene.reconstruction()
    owners = components[whole.observation_points]
    seen = owners == components[whole.observation_frames]
    statuses = whole.pose_statuses.copy()
    statuses[7] = PoseStatus.UNREFINED
    sure = np.tile(1e-12 * np.eye(6), (len(statuses), 1, 1))
    known = {"pose_statuses": statuses, "pose_covariances": sure}
    return observing(whole, seen, components=components, **known)


def _report(tmp_path: Path, result: Reconstruction, reasons: tuple[str, ...] = ()) -> dict:
    coarse = CoarsePoses(result.world_T_rigs, np.zeros(scene.NUM_FRAMES, np.uint8), 0.0)
    report = build_report(
        settings=RefineSettings(),
        frames=scene.panoramas(tmp_path),
        coarse=coarse,
        reconstruction=result,
        stages=StageLog(),
        gauge="",
        found=Findings(reasons=reasons),
    )
    return json.loads(json.dumps(report))


def test_maps_are_listed_with_their_frames(tmp_path: Path) -> None:
    frames, result = scene.panoramas(tmp_path), _in_maps()
    names = frames.names
    largest, other = summarize_maps(result, frames, ("", "too few matches"))
    positions = result.world_T_rigs[[0, 1, 4, 5, 7], :3, 3]
    extent = float(np.linalg.norm(positions.max(axis=0) - positions.min(axis=0)))
    spans = ((names[0], names[1]), (names[4], names[5]), (names[7], names[7]))
    assert largest == MapSummary(1, 5, 4, 2, 5, extent, spans, None)
    assert (other.map, other.frames, other.refined, other.steps, other.points) == (2, 2, 2, 0, 2)
    assert other.spans == ((names[2],) * 2, (names[6],) * 2)
    assert other.reason == "too few matches"
    assert summarize_maps(result, frames)[1].reason is None
    (single,) = summarize_maps(scene.reconstruction(), frames)
    assert (single.frames, single.steps) == (scene.NUM_FRAMES, scene.NUM_FRAMES - 1)


def test_the_summary_counts_the_exported_map_alone(tmp_path: Path) -> None:
    result = _in_maps()
    summary = _report(tmp_path, result)["summary"]
    counts = {"frames": 9, "exported": 5, "refined": 4, "maps": 2, "points": 5}
    counts |= {"frames_in_other_maps": 2, "frames_in_no_map": 2, "observations": 25}
    assert {name: summary[name] for name in counts} == counts
    assert summary["median_residual_deg"] == pytest.approx(0, abs=1e-6)


def test_the_outcome_says_frames_in_other_maps_first(tmp_path: Path) -> None:
    text = format_outcome(_report(tmp_path, _in_maps(), ("", "too few matches")), "out")
    first, header, *rows = text.splitlines()[:4]
    reason, command, *reasons, verdict = text.splitlines()[4:]
    held = "1 with the pose of the trajectory file"
    assert first.startswith(f"4 of 9 frames refined ({held}, 2 in another map, 2 in no map), 5 poi")
    assert first.endswith(": out")
    assert reason.count("frame_000") == 4
    assert command == "  gsba export out --to colmap --map 2"
    assert [line.count("frame_000") for line in reasons] == [1, 0, 3, 0]
    assert verdict.startswith("look at these places: 5 of 9 frames are in the map")
    assert header.split()[:5] == ["map", "frames", "steps", "points", "extent"]
    assert rows[0].split()[:4] == ["1", "5", "2", "5"] and len(rows) == 2
    assert rows[1].split()[:4] == ["2", "2", "0", "2"] and rows[1].endswith("  too few matches")
    unknown = format_outcome(_report(tmp_path, _in_maps()), "out")
    assert "why it was not joined" in header and "why" not in unknown
    whole = format_outcome(_report(tmp_path, scene.reconstruction()), "out")
    first, *_, verdict = whole.splitlines()
    assert first.startswith("9 of 9 frames refined, 9 points")
    assert "all 9 frames are in one map" in verdict


def test_rows_of_many_spans_stay_short(tmp_path: Path) -> None:
    result = _in_maps(np.array([0, 1, 0, 1, 0, 1, 0, 1, 0], np.int32))
    rows = format_outcome(_report(tmp_path, result), "out").splitlines()[2:4]
    assert [row[row.index("0.") :].count(",") for row in rows] == [3, 3]
    assert rows[0].endswith(", 2 more") and rows[1].endswith(", 1 more")


@pytest.mark.parametrize(
    ("inside", "frames", "partial"),
    [
        (9, 10, False),
        (8, 10, True),
        (63, 70, False),
        (62, 70, True),
        (10, 11, False),
        (1, 1, False),
    ],
)
def test_a_run_is_partial_below_nine_tenths(inside: int, frames: int, partial: bool) -> None:
    largest = MapSummary(1, inside, inside, inside - 1, 0, 1.0, (), None)
    assert is_partial([largest], frames) == partial
