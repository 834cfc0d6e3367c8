"""Masks of several recordings: each gets those that it asks for."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from plain_records import frames_of
from refusals import refused

from gsba.disk import write_image
from gsba.frames.masks import load_mask
from gsba.log import GsbaError
from gsba.masks import merging
from gsba.masks.carrier import Carrier
from gsba.masks.distractors import Distractors
from gsba.masks.merging import Choice, choose
from gsba.store.store import RunStore
from gsba.types import FrameSet, PictureFormat


@pytest.fixture
def recordings(tmp_path: Path) -> FrameSet:
    """Three of two panoramas each, black at the lowest rows."""
    rng, paths = np.random.default_rng(0), []
    for f in range(6):
        paths.append((tmp_path / f"{f}.png",))
        picture = rng.integers(40, 255, (256, 512, 3)).astype(np.uint8)
        picture[-32:] = 0
        write_image(paths[-1][0], picture)
    return replace(
        frames_of(PictureFormat("erp", 512, 256), paths),
        names=tuple(f"{name}/{f}" for name in "abc" for f in range(2)),
        clock_shifts=(0.0, 0.0, 10.0, 10.0, 20.0, 20.0),
    )


def _hidden(frames: FrameSet) -> list[float]:
    """Share of the first picture of each recording that its mask hides."""
    masks = [load_mask(frames, f) for f in (0, 2, 4)]
    return [0.0 if mask is None else float(1 - mask.mean()) for mask in masks]


def _asking(**masks: merging.Masks) -> Choice:
    return Choice.joined({name: choose(values) for name, values in masks.items()})


def test_borders_are_masked_where_a_recording_asks(recordings: FrameSet, tmp_path: Path) -> None:
    with RunStore(tmp_path / "run", {"frames": tmp_path}) as store:
        chosen = _asking(a="auto", b="none", c="none")
        hidden = _hidden(merging.before(store, recordings, chosen))
    assert hidden[0] >= 0.1 and hidden[1:] == [0, 0]


def test_padding_of_a_recording_amid_others_is_masked(
    recordings: FrameSet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever --masks says."""
    second = {recordings.paths[f][0] for f in (2, 3)}

    def header(path: Path) -> Any:
        return SimpleNamespace(crop=(0, 0, 512, 256) if path in second else None)

    monkeypatch.setattr("gsba.masks.borders.image_header", header)
    with RunStore(tmp_path / "run", {"frames": tmp_path}) as store:
        chosen = _asking(a="none", b="none", c="none")
        hidden = _hidden(merging.before(store, recordings, chosen))
    assert hidden[1] >= 0.1 and hidden[::2] == [0, 0]


def test_a_carrier_is_required_where_a_recording_requires_it(
    recordings: FrameSet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def find(frames: FrameSet) -> Carrier:
        if frames.names[0] != "a/0":
            raise GsbaError("too few frames")
        mask = np.ones((32, 64), bool)
        mask[-8:] = False
        return Carrier(mask, np.zeros(2), np.zeros((32, 64, 3), np.uint8), 0.1, "")

    monkeypatch.setattr(merging, "find_carrier", find)
    with RunStore(tmp_path / "run", {"frames": tmp_path}) as store:
        found = merging.before(store, recordings, _asking(a="carrier", b="auto", c="none"))
        hidden = _hidden(found)
        required = _asking(a="auto", b="carrier", c="none")
        refused("too few frames", merging.before, store, recordings, required)
    assert hidden[0] > hidden[1] and hidden[2] == 0


def test_distractors_are_masked_where_a_recording_asks(
    recordings: FrameSet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def look(scene: object, numbers: dict[str, int]) -> Any:
        everything = np.array(cv2.imencode(".png", np.zeros((32, 64), np.uint8))[1])
        return lambda name: Distractors(everything, 1.0, "")

    monkeypatch.setattr(merging, "StaticScene", lambda *_: None)
    monkeypatch.setattr(merging, "Look", look)
    solved: Any = SimpleNamespace(world_T_rigs=None, landmarks=None)
    for masks in ({"a": "none", "b": "distractors", "c": "none"}, {"c": "distractors"}):
        with RunStore(tmp_path / "run", {"frames": tmp_path}) as store:
            store.stage("solved", None, lambda: True, bool)
            chosen = _asking(**(dict.fromkeys("abc", "none") | masks))
            merged, counts = merging.after(store, recordings, chosen, solved, "solved")
            hidden = _hidden(merged)
        assert counts.received == 2
        assert hidden == [float("distractors" in masks.get(name, "")) for name in "abc"]


def test_a_carrier_that_turns_is_masked_behind_a_recording_of_cube_faces(
    recordings: FrameSet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whose faces are as wide as the panoramas."""
    mask = np.ones((32, 64), bool)
    mask[-8:, :8] = False
    turned = Carrier(mask, np.array([0, 0.5]), np.zeros((32, 64, 3), np.uint8), 0.1, "")
    monkeypatch.setattr(merging, "find_carrier", lambda _: turned)
    monkeypatch.setattr(merging, "write_carrier", lambda *_, **__: [])
    cube = PictureFormat("cube", 512, 512, ("front", "right", "back", "left", "up", "down"))
    frames = replace(
        recordings, formats=(cube, *recordings.formats), camera_of_frame=(0, 0, 1, 1, 1, 1)
    )
    with RunStore(tmp_path / "run", {"frames": tmp_path}) as store:
        found = merging.before(store, frames, _asking(a="none", b="auto", c="none"))
    hidden = [np.flatnonzero(~np.array(load_mask(found, f))[200]) for f in (2, 3)]
    assert hidden[0][0] == 0 and (hidden[1] - hidden[0] == round(512 * 0.5 / (2 * np.pi))).all()
