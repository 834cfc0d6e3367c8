"""Frames of several recordings as one set: names, times and what cannot be combined."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from plain_records import frames_of
from refusals import refused

from gsba.frames.recordings import combine, own_timestamps
from gsba.types import FrameSet, PictureFormat

NUM = 4


def _frames(folder: Path, start: float, interval: float = 0.5) -> FrameSet:
    folder.mkdir()
    names = tuple(f"{n:03d}" for n in range(NUM))
    for name in names:
        (folder / f"{name}.jpg").write_text(f"{folder.name} {name}")
    paths, times = [(folder / f"{name}.jpg",) for name in names], start + interval * np.arange(NUM)
    return frames_of(PictureFormat("erp", 512, 256), paths, times, names)


def test_recordings_follow_one_another_whatever_their_clocks(tmp_path: Path) -> None:
    first, second = _frames(tmp_path / "a", 1.7e9), _frames(tmp_path / "b", 1.7e9 - 0.25, 2.0)
    frames = combine({"a": first, "b": second})
    assert frames.names[:1] == ("a/000",) and frames.names[NUM] == "b/000"
    rows = {name: rows.tolist() for name, rows in frames.recordings.items()}
    assert rows == {"a": [0, 1, 2, 3], "b": [4, 5, 6, 7]}
    steps = np.diff(frames.timestamps)
    assert (steps > 0).all() and steps[NUM - 1] >= 100 * 2.0
    both = np.concatenate([first.timestamps, second.timestamps])
    np.testing.assert_allclose(own_timestamps(frames), both, rtol=0, atol=1e-6)
    some = frames.taken(np.array([1, 5, 6]))
    assert list(some.recordings) == ["a", "b"]
    np.testing.assert_allclose(own_timestamps(some), own_timestamps(frames)[[1, 5, 6]])


def test_each_recording_has_times_or_none(tmp_path: Path) -> None:
    frames = {name: _frames(tmp_path / name, 0.0) for name in "abc"}
    frames["b"] = replace(frames["b"], timed=False)
    together = combine(frames)
    assert not together.timed
    of_each = {name: together.taken(rows) for name, rows in together.recordings.items()}
    assert {name: one.timed for name, one in of_each.items()} == {"a": True, "b": False, "c": True}
    assert combine({name: frames[name] for name in "ac"}).timed
    assert together.taken(np.array([0, NUM])).timed_frames.tolist() == [True, False]


def test_recordings_of_one_mode_share_a_camera(tmp_path: Path) -> None:
    names = "abcd"
    frames = {name: _frames(tmp_path / name, 0.0) for name in names}
    frames["b"] = frames["b"].with_formats([PictureFormat("erp", 384, 192)])
    together = combine(frames)
    assert together.formats == (PictureFormat("erp", 512, 256), PictureFormat("erp", 384, 192))
    assert together.cameras.tolist() == [0] * NUM + [1] * NUM + [0] * 2 * NUM
    assert together.format_of(NUM).width == 384
    with pytest.raises(ValueError, match="too many values"):
        _ = together.format
    one = together.taken(np.arange(NUM, 2 * NUM))  # of one recording: its camera alone
    assert one.format.width == 384 and one.camera_of_frame == ()
    some = together.taken(np.array([1, NUM + 1, 3 * NUM]))
    assert [kind.width for kind in some.formats] == [512, 384]
    assert some.camera_of_frame == (0, 1, 0)


def test_named_models_tell_cameras_of_one_mode_apart(tmp_path: Path) -> None:
    frames = {name: _frames(tmp_path / name, 0.0) for name in "abc"}
    together = combine(frames, {"a": "insta360-x3", "b": "insta360-x5"})
    assert together.cameras.tolist() == [0] * NUM + [1] * NUM + [0] * NUM
    assert len(set(together.formats)) == 1 and len(together.formats) == 2
    alike = combine(frames, {"b": "insta360-x5"})  # one name is as good for the others
    assert len(alike.formats) == 1 and alike.camera_of_frame == ()


def test_what_cannot_be_combined_is_refused(tmp_path: Path) -> None:
    first, second = _frames(tmp_path / "a", 0.0), _frames(tmp_path / "b", 0.0)
    refused("'a' and 'c' are the same", combine, {"a": first, "b": second, "c": first})
    refused("cannot be that of a folder", combine, {"a/b": first, "c": second})
    for name in second.names:  # a copy under another name
        (tmp_path / "b" / f"{name}.jpg").write_text(f"a {name}")
    refused("hold the same pictures", combine, {"a": first, "b": second})


@pytest.mark.parametrize("name", ["a/b/c", "../a", "a/..", "/a"])
def test_names_lead_out_of_no_folder(name: str, tmp_path: Path) -> None:
    frames = combine({"a": _frames(tmp_path / "a", 0.0), "b": _frames(tmp_path / "b", 0.0)})
    with pytest.raises(ValueError, match="cannot be the name of a frame"):
        replace(frames, names=(name, *frames.names[1:]))
