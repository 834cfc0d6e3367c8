"""Exports that are stopped: what is finished is kept for the same call, and for no other."""

import itertools
import os
from pathlib import Path

import pytest
from export_scene import contents, panoramas, reconstruction

from gsba.disk import hold_folder
from gsba.export import ExportFormat, export, images, pictures
from gsba.log import GsbaError, StoppedError
from gsba.store.shards import Threads
from gsba.types import FrameSet


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> FrameSet:
    return panoramas(tmp_path_factory.mktemp("scene") / "frames", ".jpg", masked=True)


def _stopped(frames: FrameSet, out: Path, to: ExportFormat, error: type[BaseException], **how):
    """Have an export end after two frames."""
    real, calls = pictures.Pictures.__call__, itertools.count()

    def call(self: pictures.Pictures, item: int) -> None:
        if next(calls) == 2:
            raise error("stop")
        real(self, item)

    with pytest.MonkeyPatch.context() as patch, pytest.raises(error, match="stop"):
        patch.setattr(images, "Threads", lambda _: Threads(1))
        patch.setattr(pictures.Pictures, "__call__", call)
        export(reconstruction(), frames, out, to, **how)


def _times(folder: Path) -> dict[str, int]:
    """When files of frames were written."""
    files = (path for path in folder.rglob("*_000*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.stat().st_mtime_ns for path in files}


def _entries(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("error", [KeyboardInterrupt, StoppedError])
@pytest.mark.parametrize("to", [ExportFormat.COLMAP, ExportFormat.NERFSTUDIO, ExportFormat.TUM])
def test_the_same_call_goes_on(tmp_path: Path, frames: FrameSet, to, error) -> None:
    how = {"images": "panorama"} if to == ExportFormat.TUM else {}
    _stopped(frames, tmp_path / "out", to, error, **how)
    (partial,) = tmp_path.iterdir()
    kept = _times(partial)
    assert any("_0000" in name for name in kept) and not any("_0002" in name for name in kept)
    export(reconstruction(), frames, tmp_path / "out", to, **how)
    assert kept.items() <= _times(tmp_path / "out").items()
    export(reconstruction(), frames, tmp_path / "anew", to, **how)
    assert contents(tmp_path / "out") == contents(tmp_path / "anew")
    assert _entries(tmp_path) == ["anew", "out"]


@pytest.mark.parametrize("changed", ["picture", "size"])
def test_another_call_begins_anew(tmp_path: Path, frames: FrameSet, changed: str) -> None:
    _stopped(frames, tmp_path / "out", ExportFormat.COLMAP, KeyboardInterrupt)
    kept = _times(next(tmp_path.iterdir()))
    if changed == "picture":
        os.utime(frames.paths[1][0], ns=(0, 0))  # as if another one were there now
    size = 64 if changed == "size" else None
    export(reconstruction(), frames, tmp_path / "out", ExportFormat.COLMAP, size)
    assert not kept.items() & _times(tmp_path / "out").items()
    assert _entries(tmp_path) == ["out"]


def test_an_export_that_fails_leaves_nothing(tmp_path: Path, frames: FrameSet) -> None:
    _stopped(frames, tmp_path / "out", ExportFormat.COLMAP, GsbaError)
    assert _entries(tmp_path) == []


def test_what_another_process_is_writing_is_left_alone(tmp_path: Path, frames: FrameSet) -> None:
    for name in ("held", "left"):
        (tmp_path / f".out.partial-{name}").mkdir()
    lock = hold_folder(tmp_path / ".out.partial-held")
    export(reconstruction(), frames, tmp_path / "out", ExportFormat.TUM)
    os.close(lock)
    assert _entries(tmp_path) == [".out.partial-held", "out"]


def test_two_of_the_same_do_not_meet(tmp_path: Path, frames: FrameSet) -> None:
    _stopped(frames, tmp_path / "out", ExportFormat.COLMAP, KeyboardInterrupt)
    lock = hold_folder(next(tmp_path.iterdir()))
    with pytest.raises(GsbaError, match="in use by another gsba process"):
        export(reconstruction(), frames, tmp_path / "out", ExportFormat.COLMAP)
    os.close(lock)
    assert any("_0000" in name for name in _times(tmp_path))
