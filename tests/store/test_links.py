"""Links and pipes in folders of runs: nothing elsewhere is deleted or written, nothing waits."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import export_scene as scene
import numpy as np
import pytest
from command import run_gsba
from refusals import refused

from gsba.disk import refuse_links
from gsba.export.folder import output_folder
from gsba.log import GsbaError
from gsba.store.store import RunStore
from gsba.types import Counts

_KINDS = "is (a link|no folder, or no ordinary file,) where gsba keeps its own files: move it away"


@pytest.fixture
def elsewhere(tmp_path: Path) -> Path:
    """A folder that is none of a run's, with files named as a run names its own."""
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    for name in ("some.npz", "cost.json", "a.npz", "HASH.job"):
        (folder / name).write_text("precious")
    return folder


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of which something is finished."""
    root = tmp_path_factory.mktemp("made") / "run"
    with RunStore(root, {}) as store:
        store.stage("some", None, lambda: Counts(3, 2, "frames"), Counts)
        list(store.per_frame("many", None, {"a": 1}, lambda _: np.zeros(3), np.ndarray))
    scene.save_run(root)
    return root


@pytest.fixture
def run(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "run"))


def _contents(folder: Path) -> dict[str, str]:
    return {path.name: path.read_text() for path in folder.iterdir()}


def _link(path: Path, to: Path) -> None:
    if path.is_dir():
        path.rename(path.with_name(f"{path.name}-before"))
    path.unlink(missing_ok=True)
    path.symlink_to(to)


def _pipe(path: Path, _: Path) -> None:
    path.unlink(missing_ok=True)
    os.mkfifo(path)


@pytest.mark.parametrize("fresh", [False, True])
@pytest.mark.parametrize(
    ("place", "plant"),
    [
        ("stages", _link),
        ("stages/many", _link),
        ("stages/shards", _link),
        ("stages/some.npz", _link),
        ("stages/many/a.npz", _link),
        ("masks", _link),
        ("stages/some.npz", _pipe),
        ("stages/many/cost.json", _pipe),
        ("trajectory.tum", _pipe),
    ],
)
def test_a_run_goes_on_in_no_other_folder(
    run: Path, elsewhere: Path, place: str, plant: Callable[[Path, Path], None], fresh: bool
) -> None:
    plant(run / place, elsewhere)
    before, marker = _contents(elsewhere), (run / "gsba.json").read_bytes()
    refused(_KINDS, RunStore, run, {}, fresh)
    assert _contents(elsewhere) == before and (run / "gsba.json").read_bytes() == marker
    (run / place).unlink()
    RunStore(run, {}, fresh).__exit__()  # and it is not held any more


@pytest.mark.parametrize(
    ("place", "plant"),
    [
        ("stages", _link),
        ("stages/frames.npz", _link),
        ("stages/frames.npz", _pipe),
        ("config.toml", _pipe),
        ("colmap", _link),
        ("trajectory.tum", _pipe),
    ],
)
@pytest.mark.parametrize("command", ["export", "evaluate"])
def test_results_are_read_from_no_pipe(
    run: Path, elsewhere: Path, place: str, plant: Callable[[Path, Path], None], command: str
) -> None:
    plant(run / place, elsewhere)
    truth = run.parent / "true.tum"
    truth.write_text("0 0 0 0 0 0 0 1\n")
    with_ = {"export": ["--to", "colmap"], "evaluate": ["--truth", str(truth)]}[command]
    told = run_gsba(command, run, *with_)
    (line,) = told.stderr.splitlines()
    assert told.exit_code == 1 and "where gsba keeps its own files: move it away" in line
    assert set(_contents(elsewhere).values()) == {"precious"}


def test_a_half_written_export_that_links_elsewhere_is_not_taken_up(
    tmp_path: Path, elsewhere: Path
) -> None:
    (tmp_path / f".out.partial-{'k' * 16}").symlink_to(elsewhere)
    os.mkfifo(tmp_path / ".out.partial-other")
    with (
        pytest.raises(GsbaError, match=_KINDS),
        output_folder(tmp_path / "out", "colmap", "k" * 64) as folder,
    ):
        (folder / "some.npz").write_text("written")
    assert set(_contents(elsewhere).values()) == {"precious"}
    with output_folder(tmp_path / "out", "colmap", "z" * 64):
        pass  # waits for no pipe


def test_folders_of_files_alone_are_kept(tmp_path: Path) -> None:
    (tmp_path / "a/b").mkdir(parents=True)
    (tmp_path / "a/b/c").symlink_to(tmp_path)
    refuse_links(tmp_path)
    refuse_links(tmp_path / "not there", below=True)
    refused(r"a/b/c is a link", refuse_links, tmp_path, below=True)
    refused(r"a/b/c is a link", refuse_links, tmp_path / "a/b/c")
