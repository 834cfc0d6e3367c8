"""A segmentation model of the user's own: its masks reach the run, its failures are one line."""

import dataclasses
import shlex
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from plain_records import frames_of
from refusals import refused
from two_fisheyes import made_pair, picture, write

from gsba.frames.masks import load_mask
from gsba.frames.scan import scan
from gsba.log import GsbaError
from gsba.masks.merging import before, choose
from gsba.masks.segmentation import Segment, load_segmented, segmented
from gsba.store.store import RunStore
from gsba.types import FACES, FrameSet, PictureFormat

WIDTH, NUM = 128, 3


@pytest.fixture
def frames(tmp_path: Path) -> FrameSet:
    folder = tmp_path / "frames"
    folder.mkdir()
    rng = np.random.default_rng(0)
    for f in range(NUM):
        image = rng.integers(60, 200, (WIDTH // 2, WIDTH, 3), dtype=np.uint8)
        image[:, : WIDTH // 4] = 0  # half of the back face and of the left one
        cv2.imwrite(str(folder / f"f{f}.png"), image)
    return scan(folder, order_suffices=True)


def _python(tmp_path: Path, code: str) -> str:
    """A command that runs some code with `images` and `masks`, folders or files."""
    script = tmp_path / "model.py"
    head = "import sys, cv2, numpy as np\nfrom pathlib import Path\n"
    script.write_text(f"{head}images, masks = map(Path, sys.argv[1:3])\n{code}\n")
    return f"{shlex.quote(sys.executable)} {shlex.quote(str(script))}"


_DARK = "cv2.imwrite(str(masks{0}), np.uint8(cv2.imread(str(p)).max(axis=2) > 20) * 255)"
_ALL = f"for p in sorted(images.iterdir()): {_DARK.format(' / p.name')}"


def _run(tmp_path: Path, frames: FrameSet, segment: Segment) -> FrameSet:
    with RunStore(tmp_path / "run", {"frames": tmp_path / "frames"}) as store:
        return before(store, frames, choose(None, segment))


def _is_dark_left_out(frames: FrameSet) -> bool:
    for f in range(len(frames)):
        mask = load_mask(frames, f)
        assert np.mean(mask[:, : WIDTH // 4]) < 0.05 and np.mean(mask[:, WIDTH // 4 :]) > 0.95
    return True


def test_a_command_masks_folders(tmp_path: Path, frames: FrameSet) -> None:
    masked = _run(tmp_path, frames, _python(tmp_path, _ALL))
    assert masked.mask_paths[1] == tmp_path / "run/masks/f1.png"
    assert _is_dark_left_out(masked)
    assert not (tmp_path / "run/stages/segmented-faces").exists()


def test_places_of_the_folders_can_be_named(tmp_path: Path, frames: FrameSet) -> None:
    swapped = _python(tmp_path, f"images, masks = masks, images\n{_ALL}")
    assert _is_dark_left_out(_run(tmp_path, frames, f"{swapped} {{masks}} {{images}}"))


def test_a_command_for_each_face(tmp_path: Path, frames: FrameSet) -> None:
    two = dataclasses.replace(frames, names=frames.names[:1], paths=frames.paths[:1])
    two = dataclasses.replace(two, mask_paths=(None,), timestamps=np.zeros(1))
    each = _python(tmp_path, f"p = images\n{_DARK.format('')}")
    assert _is_dark_left_out(_run(tmp_path, two, f"{each} {{image}} {{mask}}"))


def test_a_command_is_resumed_and_a_callable_is_not(tmp_path: Path, frames: FrameSet) -> None:
    counted = f"with open({str(tmp_path / 'calls')!r}, 'a') as file: file.write('x')\n{_ALL}"
    command = _python(tmp_path, counted)
    calls = []

    def dark(face: np.ndarray) -> np.ndarray:
        calls.append(face.shape)
        return face.max(axis=2) > 20

    for _ in range(2):
        masked = _run(tmp_path, frames, command)
    assert (tmp_path / "calls").read_text() == "x"
    times = [path.stat().st_mtime_ns for path in masked.mask_paths if path]
    for _ in range(2):
        masked = _run(tmp_path, frames, dark)
    assert _is_dark_left_out(masked) and calls == [(32, 32, 3)] * 2 * 6 * NUM
    assert [path.stat().st_mtime_ns for path in masked.mask_paths if path] == times


def test_masks_meet_the_directions_of_their_faces(tmp_path: Path, frames: FrameSet) -> None:
    """A face that is masked altogether covers its owner pixels of the panorama, and only those."""
    number = iter(range(6 * NUM))

    def all_but_right(face: np.ndarray) -> np.ndarray:
        return np.full(face.shape[:2], FACES[next(number) % 6] != "right")

    with RunStore(tmp_path / "run", {"frames": tmp_path / "frames"}) as store:
        mask = load_segmented(segmented(store, frames, all_but_right), frames, 0)
    row = ~mask[WIDTH // 4]
    assert row.sum() == WIDTH // 4 and row[5 * WIDTH // 8 : 7 * WIDTH // 8].all()
    assert not (~mask[0]).any() and not (~mask[-1]).any()


@pytest.mark.parametrize(
    ("code", "message"),
    [
        ("sys.exit('out of memory')", "failed with exit code 1: out of memory"),
        ("sys.exit(3)", "failed with exit code 3: it printed nothing"),
        (f"{_ALL}\n(masks / 'f1_up.png').unlink()", r"wrote no mask f1_up.png \(1 of 18 missing\)"),
        ("pass", r"wrote no mask f0_front.png \(18 of 18 missing\)"),
        (f"{_ALL}\ncv2.imwrite(str(masks / 'f2_up.png'), np.zeros((9, 8), np.uint8))", "is 8x9"),
        (
            f"{_ALL}\n(masks / 'f0_up.png').write_text('no')",
            "f0_up.png: not a JPEG, PNG, WebP or TIFF image",
        ),
    ],
)
def test_what_a_command_does_wrong(
    tmp_path: Path, frames: FrameSet, code: str, message: str
) -> None:
    refused(message, _run, tmp_path, frames, _python(tmp_path, code))
    assert not (tmp_path / "run/masks").exists()


def test_what_is_no_command(tmp_path: Path, frames: FrameSet) -> None:
    for command, message in (
        ("no-such-model-here", "cannot be run"),
        ("'open", "No closing quotation"),
        (" ", "no command given"),
    ):
        refused(message, _run, tmp_path, frames, command)
    with pytest.raises(GsbaError, match=r"mask of f0, front is float64 of shape \(2, 2\)"):
        _run(tmp_path, frames, lambda _: np.ones((2, 2)))


def test_raw_fisheyes_are_masked_again_where_another_calibration_cuts_them(tmp_path: Path) -> None:
    pair, shown = made_pair(64), list[np.ndarray]()
    paths = [write(tmp_path / f"{n}.png", picture(lens)) for n, lens in enumerate(pair)]
    for focal in (pair[0].focal, 1.2 * pair[0].focal):
        lenses = dataclasses.replace(pair[0], focal=focal), pair[1]
        frames = frames_of(PictureFormat("fisheye", 128, 64, fisheyes=lenses), [tuple(paths)])
        with RunStore(tmp_path / "run", {"frames": tmp_path}) as store:
            found = segmented(store, frames, "cp {image} {mask}")
            assert not store.records["segmented"].resumed
            shown.append(load_segmented(found, frames, 0))
    assert np.mean(shown[0] != shown[1]) > 0.02
