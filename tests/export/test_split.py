"""Held-out panoramas, by the rules of the programs that read an export."""

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from export_scene import exported, panoramas, reconstruction

from gsba.export import ExportFormat, export
from gsba.export.split import TRAIN_LIST, DatasetSplit, add_images, split_of
from gsba.frames.held_out import held_out_rows
from gsba.log import GsbaError
from gsba.types import PoseStatus, Reconstruction


def _numbers(split: DatasetSplit) -> tuple[np.ndarray, np.ndarray]:
    """Frame of each image in order, and whether a reader holds it out."""
    images = sorted((n, f) for f, own in enumerate(split.numbers) for n in own if n >= 0)
    places, frames = np.array(images).T
    assert places.tolist() == list(range(len(places)))
    return frames, places % 8 == 0


def _of_frames(num: int) -> Reconstruction:
    statuses = np.full(num, PoseStatus.REFINED, np.uint8)
    return replace(reconstruction(), pose_statuses=statuses)


@pytest.mark.parametrize("views", [(6,), (10,), (2,), (6, 10, 2)])
def test_every_eighth_image_is_of_a_held_out_panorama_and_no_other_is(views: tuple) -> None:
    for num in range(3, 60):
        num_views = [views[f % len(views)] for f in range(num)]
        split = split_of(_of_frames(num), num_views)
        frames, held = _numbers(split)
        assert set(frames[held]) == set(np.flatnonzero(split.held_out))
        assert not split.held_out[frames[~held]].any()
        training = sum(n for n, out in zip(num_views, split.held_out, strict=True) if not out)
        assert np.count_nonzero(~held) == training  # nothing is lost that is trained on
        assert len(views) > 1 or np.count_nonzero(split.held_out) == -(-num // 8)


def test_unrefined_frames_are_not_held_out() -> None:
    scene = _of_frames(24)
    scene.pose_statuses[:10] = PoseStatus.UNREFINED
    split = split_of(scene, [6] * 24)
    assert split is not None and not split.held_out[:10].any()
    frames, held = _numbers(split)
    assert set(frames[held]) == set(np.flatnonzero(split.held_out))


def test_two_panoramas_are_both_for_training(caplog: pytest.LogCaptureFixture) -> None:
    assert split_of(_of_frames(2), [6, 6]) is None
    assert "too few panoramas to hold one of 8 out: all images are for training" in caplog.text


def test_a_split_that_is_asked_for_is_not_dropped(tmp_path: Path) -> None:
    frames, scene = panoramas(tmp_path / "frames").taken(np.arange(2)), reconstruction()
    scene, out = scene.taken(np.arange(2)), tmp_path / "out"
    for to in (ExportFormat.COLMAP_FLAT, ExportFormat.NERFSTUDIO):
        with pytest.raises(GsbaError, match=r"2 refined panoramas are too few.*use --no-split"):
            export(scene, frames, out, to, face_size=16, split=True)
    for to in set(ExportFormat) - {ExportFormat.COLMAP_FLAT, ExportFormat.NERFSTUDIO}:
        with pytest.raises(GsbaError, match=f"colmap-flat and nerfstudio, not in {to.value}"):
            export(scene, frames, out, to, split=True)
    assert [path.name for path in tmp_path.iterdir()] == ["frames"]


def test_photos_hold_no_other_panoramas_out(tmp_path: Path) -> None:
    """Photos fill the order up: faces of held-out panoramas come first, then every eighth photo."""
    (tmp_path / "sparse/0").mkdir(parents=True)
    alone = split_of(_of_frames(20), [6] * 20)
    for num in (1, 5, 30, 300):
        split = split_of(_of_frames(20), [6] * 20, num)
        np.testing.assert_array_equal(split.held_out, alone.held_out)
        split.write_lists(tmp_path, [[f"{n:05d}" for n in own] for own in split.numbers])
        taken = [n for own in split.numbers for n in own if n >= 0]
        photos = add_images(tmp_path, taken, [f"photo_{k}" for k in range(num)])
        order = sorted(taken + list(photos.values()))
        assert order == list(range(len(taken) + num))
        frame_of = {n: f for f, own in enumerate(split.numbers) for n in own}
        held = [n for n in order if n % 8 == 0]
        assert all(split.held_out[frame_of[n]] for n in held if n in frame_of)
        tested, trained = (
            sorted(int(name[:5]) for name in (tmp_path / path).read_text().split())
            for path in ("test_list.txt", TRAIN_LIST)
        )
        assert tested == held and trained == [n for n in order if n % 8]


def test_held_out_rows_are_spread_and_at_no_end() -> None:
    assert held_out_rows(16).tolist() == [4, 12] and held_out_rows(41).tolist()[-1] == 37
    assert held_out_rows(0).tolist() == []


def test_readers_by_name_by_number_and_by_list_hold_the_same_panoramas_out(tmp_path: Path) -> None:
    frames, scene = panoramas(tmp_path / "frames", masked=True), reconstruction()
    chosen = np.arange(7)  # no multiple of eight images
    frames, scene = frames.taken(chosen), scene.taken(chosen)
    out = tmp_path / "out"
    export(scene, frames, out, ExportFormat.COLMAP_FLAT, face_size=16)
    images = pycolmap.Reconstruction(out / "sparse/0").images
    by_name = sorted(image.name for image in images.values())
    assert by_name == [images[number].name for number in sorted(images)]
    assert by_name == sorted(path.name for path in (out / "images").iterdir())
    assert by_name == sorted(path.name for path in (out / "masks").iterdir())
    test, training = by_name[::8], [name for n, name in enumerate(by_name) if n % 8]
    assert {name.split("_")[2] for name in test} == {"0003"}
    assert len(training) == 36 and not any("frame_0003" in name for name in training)
    for path in ("val_list.txt", "test_list.txt", "sparse/0/test.txt"):
        assert (out / path).read_text().split() == test
    assert (out / "train_list.txt").read_text().split() == training


def test_images_of_the_file_are_in_the_order_of_the_split(tmp_path: Path) -> None:
    """LichtFeld counts images as they come in images.bin."""
    out = exported(tmp_path, ExportFormat.COLMAP_FLAT, face_size=16)
    content = (out / "sparse/0/images.bin").read_bytes()
    (num,), at, names = struct.unpack_from("<Q", content), 8, list[str]()
    for _ in range(num):
        end = content.index(b"\0", at + 64)  # behind id, pose and camera
        names.append(content[at + 64 : end].decode())
        (num_points,) = struct.unpack_from("<Q", content, end + 1)
        at = end + 9 + 24 * num_points
    assert at == len(content) and names == sorted(names)
    assert names[::8] == (out / "test_list.txt").read_text().split()


def test_without_a_split_names_are_those_of_frames(tmp_path: Path) -> None:
    out = exported(tmp_path, ExportFormat.COLMAP_FLAT, face_size=16, split=False)
    assert (out / "images/frame_0000_front.png").is_file()
    assert not (out / "test_list.txt").exists() and not (out / "sparse/0/test.txt").exists()
