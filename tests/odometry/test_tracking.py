"""A sequence whose tracking is interrupted goes on from its checkpoint, to the same poses."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from dense_walk import WIDTH, RenderedWalk

from gsba.frames.scan import scan
from gsba.odometry import walk
from gsba.odometry.panoramas import SmallPanoramas, of_frames
from gsba.odometry.walk import Tracking, track_frames

BROKEN = 3  # the frame that cannot be read


def _panoramas(walk: RenderedWalk, folder: Path, stops: int | None = None) -> SmallPanoramas:
    """Frames of a walk, one of them damaged; read until the frame `stops`."""

    def read(rows: Sequence[int], colour: bool) -> Iterator[tuple[int, np.ndarray]]:
        for row in rows:
            if row == stops:
                raise KeyboardInterrupt
            if row != BROKEN:
                yield row, walk.frames[row]

    usable = np.ones((WIDTH // 2, WIDTH), bool)
    usable[-WIDTH // 16 :] = False
    num = min(len(walk.frames), 24)
    return SmallPanoramas(folder, np.arange(num) / 8.0, WIDTH, read, "", usable)


@pytest.fixture
def always(monkeypatch: pytest.MonkeyPatch) -> None:
    """A checkpoint after every frame."""
    monkeypatch.setattr(walk, "_CHECKPOINT_S", 0.0)
    monkeypatch.setattr(walk, "_MAX_SAVING_SHARE", 1e9)


@pytest.fixture(scope="module")
def whole(walk: RenderedWalk, tmp_path_factory: pytest.TempPathFactory) -> Tracking:
    return track_frames(_panoramas(walk, tmp_path_factory.mktemp("whole")), 0, None)


def _assert_same(found: Tracking, whole: Tracking) -> None:
    assert found.rows == whole.rows
    assert found.sharpness == whole.sharpness
    np.testing.assert_array_equal(found.state.keyframe_poses, whole.state.keyframe_poses)
    for one, other in zip(found.state.records, whole.state.records, strict=True):
        assert one.status is other.status
        np.testing.assert_array_equal(one.key_T_rig, other.key_T_rig)
    for one, other in zip(found.pictures, whole.pictures, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.usefixtures("always")
@pytest.mark.parametrize("stops", [2, 13, 21])
def test_it_goes_on_where_it_was_interrupted(
    walk: RenderedWalk, whole: Tracking, tmp_path: Path, stops: int
) -> None:
    checkpoint = tmp_path / "unfinished.npz"
    with pytest.raises(KeyboardInterrupt):
        track_frames(_panoramas(walk, tmp_path, stops), 0, checkpoint)
    rows = list[int]()
    given = _panoramas(walk, tmp_path)

    def read(some: Sequence[int], colour: bool) -> Iterator[tuple[int, np.ndarray]]:
        rows.extend(some)
        return given.read(some, colour)

    found = track_frames(replace(given, read=read), 0, checkpoint)
    assert rows[0] == stops
    _assert_same(found, whole)


@pytest.mark.usefixtures("always")
def test_a_checkpoint_of_something_else_is_not_used(
    walk: RenderedWalk, whole: Tracking, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    checkpoint = tmp_path / "unfinished.npz"
    with pytest.raises(KeyboardInterrupt):
        track_frames(_panoramas(walk, tmp_path, 9), 1, checkpoint)  # another seed
    _assert_same(track_frames(_panoramas(walk, tmp_path), 0, checkpoint), whole)
    checkpoint.write_bytes(checkpoint.read_bytes()[:-100])
    _assert_same(track_frames(_panoramas(walk, tmp_path), 0, checkpoint), whole)
    assert "tracking begins anew" in caplog.text


@pytest.mark.usefixtures("always")
def test_other_pictures_or_lenses_begin_anew(walk: RenderedWalk, tmp_path: Path) -> None:
    """Pictures of a folder that were replaced meanwhile, and raw ones with another calibration."""
    checkpoint, folder = tmp_path / "unfinished.npz", tmp_path / "frames"
    folder.mkdir()

    def write(mirrored: bool) -> SmallPanoramas:
        for n, picture in enumerate(walk.frames[:12]):
            cv2.imwrite(str(folder / f"{n:02d}.png"), picture[:, :: -1 if mirrored else 1])
        return of_frames(scan(folder, fps=8), folder, WIDTH)

    def interrupted(rows: Sequence[int], colour: bool) -> Iterator[tuple[int, np.ndarray]]:
        yield from before.read(rows[:8], colour)
        raise KeyboardInterrupt

    before = write(mirrored=False)
    with pytest.raises(KeyboardInterrupt):
        track_frames(replace(before, read=interrupted), 0, checkpoint)
    after = write(mirrored=True)
    _assert_same(track_frames(after, 0, checkpoint), track_frames(after, 0, None))
