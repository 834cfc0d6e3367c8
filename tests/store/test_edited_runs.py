"""Run folders that were edited: one line that says so, or the stage is computed again."""

import dataclasses
import json
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import export_scene as scene
import numpy as np
import pytest
from command import run_gsba
from refusals import refused

from gsba import load_run
from gsba.log import GsbaError
from gsba.placement.world import read_placement
from gsba.store.folder import open_run_folder
from gsba.store.records import RecordError, load_record, save_record, typed
from gsba.store.store import RunStore, StageRecord
from gsba.types import Counts, JointErrors, Reconstruction


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `load_run` needs of a finished run."""
    root = tmp_path_factory.mktemp("made") / "run"
    (root / "stages").mkdir(parents=True)
    (root / "gsba.json").write_text('{"origin": {}, "wrote": []}')
    scene.save_run(root)
    return root


@pytest.fixture
def run(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "run"))


def _edit(path: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    """Change the JSON tree of a record, as with an editor."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    tree = json.loads(members["manifest.json"])
    members["manifest.json"] = json.dumps(change(tree) or tree).encode()
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)


@pytest.mark.parametrize(
    "change",
    [
        lambda tree: [tree],
        lambda tree: {"format": tree["format"], "value": 3},
        lambda tree: tree["value"].update(world_T_rigs=7),
        lambda tree: tree["value"].update(world_T_rigs="nothing.npy"),
        lambda tree: tree["value"].update(world_T_rigs=["point_errors.npy"]),
        lambda tree: tree["value"].update(formats=7),
        lambda tree: tree["value"].update(formats=["x"]),
        lambda tree: tree["value"].pop("points_world"),
    ],
)
def test_an_edited_record_is_no_result(run: Path, change: Callable[[dict], Any]) -> None:
    _edit(run / "stages/reconstruction.npz", change)
    with pytest.raises(RecordError):
        load_record(run / "stages/reconstruction.npz", Reconstruction)
    refused("has no usable 'reconstruction' result", load_run, run)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("world_T_rigs", np.eye(4), "do not fit together"),
        ("pose_statuses", np.zeros(99, np.uint8), "do not fit together"),
        ("observation_frames", np.zeros(1, np.int32), "do not fit together"),
        ("points_world", np.array(1.0), "do not fit together"),
        ("components", np.zeros(1, np.int32), "do not fit together"),
        ("components", np.full(scene.NUM_FRAMES, 7, np.int32), "do not fit together"),
        ("map_scales", np.ones(2), "do not fit together"),
        ("joint_errors", JointErrors(np.zeros((0, 0)), np.zeros((0, 0))), "do not fit together"),
        ("world_T_rigs", np.full((scene.NUM_FRAMES, 4, 4), np.nan), "are not finite"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(
    run: Path, field: str, value: np.ndarray | JointErrors, message: str
) -> None:
    edited = dataclasses.replace(scene.reconstruction(), **{field: value})
    save_record(run / "stages/reconstruction.npz", edited, {})
    refused(f"{message}.* --fresh", load_run, run)


@pytest.mark.parametrize(
    "name", ["../stolen", "../../stolen", "/tmp/stolen", "a/b", "..", ".", "", "a\nb", "a\0b"]
)
def test_names_that_leave_the_folder_are_refused(run: Path, tmp_path: Path, name: str) -> None:
    """Exports name pictures after frames: the run of a stranger must not say where they go."""
    _edit(run / "stages/frames.npz", lambda tree: tree["value"]["names"].__setitem__(3, name))
    before = sorted(tmp_path.rglob("*"))
    told = run_gsba("export", run, "--to", "colmap", "--out", tmp_path / "o/u")
    assert told.exit_code == 1 and sorted(tmp_path.rglob("*")) == before
    line = told.stderr.splitlines()
    assert len(line) == 1 and "cannot be the name of a frame" in line[0], told.stderr


@pytest.mark.parametrize("path", ["a\0b", "\ud800", 3, None])
def test_paths_that_no_file_can_have_are_refused(run: Path, path: object) -> None:
    def change(tree: dict[str, Any]) -> None:
        tree["value"]["paths"][3] = [path]

    _edit(run / "stages/frames.npz", change)
    refused("has no usable 'frames' result", load_run, run)


def test_faces_that_are_none_are_refused(run: Path) -> None:
    _edit(
        run / "stages/frames.npz",
        lambda tree: tree["value"]["formats"][0].update(faces=["../front"]),
    )
    refused(r"'\.\./front' is no face of a cube", load_run, run)


def test_records_that_were_packed_are_refused(run: Path) -> None:
    """A kilobyte of zip can be a gigabyte of zeros."""
    path = run / "stages/reconstruction.npz"
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    refused("may unpack to any size", load_run, run)


@pytest.mark.parametrize("time", [np.inf, np.nan, 0.0])
def test_frames_in_no_order_of_time_are_refused(run: Path, time: float) -> None:
    frames = load_run(run)[1]
    frames.timestamps[1] = time
    save_record(run / "stages/frames.npz", frames, {})
    refused(r"timestamps do not increase.* --fresh", load_run, run)


@pytest.mark.parametrize(
    "content",
    [
        '{"origin": null, "wrote": []}',
        '{"origin": {"frames": 3}, "wrote": []}',
        '{"origin": {}, "wrote": 3}',
        '{"origin": {}, "wrote": [3]}',
        '["origin", "wrote"]',
        "3",
        "[" * 99_999,
        "",
    ],
)
def test_an_edited_marker_is_not_ours(tmp_path: Path, content: str) -> None:
    (tmp_path / "gsba.json").write_text(content)
    refused(r"gsba.json .*: choose another --out", open_run_folder, tmp_path, {}, fresh=True)
    assert (tmp_path / "gsba.json").read_text() == content


@pytest.mark.parametrize("change", [{"seconds": "long"}, {"name": 3}, {"key": None}])
def test_a_stage_whose_cost_was_edited_is_computed_again(
    tmp_path: Path, change: dict[str, Any]
) -> None:
    counts = Counts(3, 2, "frames", {"dark": 1})
    for expected in (counts, dataclasses.replace(counts, kept=1)):
        with RunStore(tmp_path / "run", {}) as store:
            assert store.stage("some", None, lambda e=expected: e, Counts) == expected
        path = tmp_path / "run/stages/some.npz"
        _edit(path, lambda tree: tree["info"].update(change))


@pytest.mark.parametrize("tree", [3, None, [], {"name": "x"}, {"name": [], "key": ""}])
def test_trees_of_another_type_are_no_records(tree: object) -> None:
    with pytest.raises(RecordError):
        typed(tree, StageRecord)


@pytest.mark.parametrize(
    "content", ["[]", "3", '{"scale": 1e999}', '{"scale": 1%s}' % ("0" * 400), "[" * 99_999]
)
def test_an_edited_placement_is_none(tmp_path: Path, content: str) -> None:
    (tmp_path / "transform.json").write_text(content)
    with pytest.raises(GsbaError, match=r"not a transform.json of gsba: export again"):
        read_placement(tmp_path / "transform.json")
