"""Masks of carriers in runs: of their own frames, and of their own camera's pictures."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from plain_records import frames_of
from two_fisheyes import write

from gsba.frames.masks import load_mask
from gsba.frames.recordings import combine
from gsba.masks import merging
from gsba.masks.borders import Borders
from gsba.masks.carrier import Carrier, no_carrier
from gsba.masks.merging import Choice, choose
from gsba.store.store import RunStore
from gsba.types import FACES, FrameSet, PictureFormat

SIZE, NUM = (256, 512), 3


@pytest.fixture
def frames(tmp_path: Path) -> FrameSet:
    """Two recordings of panoramas that are black below."""
    rng = np.random.default_rng(0)
    recordings = {}
    for name in "ab":
        files = list[tuple[Path]]()
        for n in range(NUM):
            picture = rng.integers(60, 200, (*SIZE, 3), np.uint8)
            picture[200:] = 0
            files.append((write(tmp_path / f"{name}{n}.png", picture),))
        recordings[name] = frames_of(PictureFormat("erp", *SIZE[::-1]), files)
    return combine(recordings)


def test_a_call_that_was_killed_leaves_no_mask_of_earlier_frames(
    frames: FrameSet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It had stored the carrier of other frames, but not yet written their mask."""
    first = frames.paths[0]

    def find(own: FrameSet) -> Carrier:
        found = no_carrier(own, "")
        found.mask[100:, : 40 if own.paths[0] == first else 80] = False
        return replace(found, share=0.1)

    def masked(rows: range) -> int:
        own = frames_of(frames.format, [frames.paths[f] for f in rows])
        with RunStore(tmp_path / "run", {"frames": tmp_path}) as store:
            mask = load_mask(merging.before(store, own, choose("auto")), 0)
        return np.count_nonzero(~mask[150])

    monkeypatch.setattr(merging, "find_carrier", find)
    monkeypatch.setattr(merging, "find_borders", lambda _: Borders(np.ones(SIZE, bool), 0.0))
    files = [tmp_path / "run" / name for name in ("carrier.png", "carrier_check.jpg")]
    narrow = masked(range(NUM))
    earlier = [file.read_bytes() for file in files]
    wide = masked(range(NUM, 2 * NUM))
    later = [file.read_bytes() for file in files]
    for file, content in zip(files, earlier, strict=True):
        file.write_bytes(content)
    assert narrow < wide == masked(range(NUM, 2 * NUM))
    assert [file.read_bytes() for file in files] == later


def test_a_carrier_is_masked_in_pictures_of_its_own_camera(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not in those of the first camera, whose faces are as wide as its panoramas."""
    rng, side = np.random.default_rng(0), SIZE[1]
    square = write(tmp_path / "face.png", rng.integers(60, 200, (side, side, 3), np.uint8))
    panorama = write(tmp_path / "panorama.png", rng.integers(60, 200, (*SIZE, 3), np.uint8))
    recordings = {
        "a": frames_of(PictureFormat("cube", side, side, FACES), [(square,) * 6] * NUM),
        "b": frames_of(PictureFormat("erp", *SIZE[::-1]), [(panorama,)] * NUM),
    }
    turns = np.deg2rad([0.0, 90.0, 180.0])

    def find(own: FrameSet) -> Carrier:
        found = no_carrier(own, "")
        if own.format.panoramic:
            found.mask[200:, 100:120] = False
            found = replace(found, turns=turns, share=0.01)
        return found

    monkeypatch.setattr(merging, "find_carrier", find)
    asked = {"a": choose("none"), "b": choose("carrier")}
    frames = combine(recordings)
    with RunStore(tmp_path / "run", {"frames": tmp_path}) as store:
        found = merging.before(store, frames, Choice.joined(asked))
    for f, turn in zip(range(NUM, 2 * NUM), turns, strict=True):
        rows, columns = np.nonzero(~load_mask(found, f))
        shift = round(side * turn / (2 * np.pi))
        assert rows.min() == 200 and {*columns} == {*range(100 + shift, 120 + shift)}
