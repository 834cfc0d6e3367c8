"""Pictures and facts of the list: made in the background, kept, and never in the way."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from refusals import refused
from waiting import until

from gsba.app import previews
from gsba.app.pictures import answer
from gsba.app.previews import Previews


@pytest.fixture
def root(tmp_path: Path) -> Path:
    folder = tmp_path / "root"
    (folder / "frames").mkdir(parents=True)
    (folder / "empty").mkdir()
    picture = np.zeros((320, 640, 3), np.uint8)
    picture[:, 320:] = 255
    for name in ("a.jpg", "frames/1.jpg", "frames/2.jpg"):
        cv2.imwrite(str(folder / name), picture)
    (folder / "broken.mp4").write_bytes(b"no video")
    (folder / "notes.txt").write_text("")
    return folder


@pytest.fixture
def made(root: Path, tmp_path: Path) -> Iterator[Previews]:
    found = Previews(root, tmp_path / "cache")
    yield found
    found.close()


def with_process(monkeypatch: pytest.MonkeyPatch, script: str) -> None:
    line = [sys.executable, "-c", script]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    monkeypatch.setattr(previews, "_started", lambda _: subprocess.Popen(line, **pipes))  # type: ignore[call-overload]


def test_a_list_is_filled_in_the_background_and_kept(
    root: Path, made: Previews, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    paths = [root / n for n in ("a.jpg", "frames", "broken.mp4", "empty", "notes.txt")]
    first = made.about(paths)
    assert [one["pending"] for one in first] == [True, True, True, True, False]
    until(lambda: not any(one["pending"] for one in made.about(paths)), 60)
    image, folder, broken, empty, notes = made.about(paths)
    assert image["facts"]["size"] == "640x320" and image["picture"]
    assert folder["picture"] and folder["problem"] == ""  # as a row: it may hold recordings
    assert not broken["picture"] and "broken.mp4" in broken["problem"] and broken["facts"] == {}
    assert not (empty["picture"] or notes["picture"] or empty["facts"])
    small = cv2.imread(str(made.picture(root / "a.jpg")))
    assert small is not None and small.shape == (160, 320, 3)
    assert small[80, 20].max() < 10 and small[80, 300].min() > 245
    with_process(monkeypatch, "raise SystemExit")  # the next server finds them on the disk
    other = Previews(root, tmp_path / "cache")
    assert not any(one["pending"] for one in other.about(paths[:2]))
    cv2.imwrite(str(root / "a.jpg"), np.zeros((100, 200, 3), np.uint8))  # another picture
    assert other.about(paths[:1])[0]["pending"]
    other.close()


@pytest.mark.parametrize(
    ("script", "message"),
    [
        ("input(); raise SystemExit", "its decoder stopped"),
        ("import time; time.sleep(600)", "it took more than 0 s"),
        ("input(); print('no answer', flush=True); input()", "its decoder stopped"),
    ],
)
def test_a_decoder_that_crashes_or_hangs_is_said(
    root: Path, made: Previews, monkeypatch: pytest.MonkeyPatch, script: str, message: str
) -> None:
    with_process(monkeypatch, script)
    monkeypatch.setattr(previews, "_LONGEST_S", 0.2 if "more than" in message else 60.0)
    refused(f"a.jpg cannot be read: {message}", made.facts, root / "a.jpg")


def test_one_task_is_answered_in_one_line(root: Path, tmp_path: Path) -> None:
    out = tmp_path / "x.jpg"
    task = {"kind": "picture", "width": 64, "share": 0.0, "out": str(out)}
    assert answer(task | {"path": str(root / "frames")}) == {}
    image = cv2.imread(str(out))
    assert image is not None and image.shape == (32, 64, 3)
    assert answer(task | {"path": str(root)}) == {}
    (root / "lenses").mkdir()
    (root / "frames").rename(root / "lenses/front")  # a folder for each lens
    assert answer(task | {"path": str(root / "lenses")}) == {}
    for path in ("broken.mp4", "empty", "notes.txt", "nothing.jpg"):
        assert path in answer(task | {"path": str(root / path)})["error"]
    run = answer({"kind": "frame", "frame": 0, "width": 64, "out": "", "path": str(root)})
    assert "is not a gsba run" in run["error"] or "root" in run["error"]
