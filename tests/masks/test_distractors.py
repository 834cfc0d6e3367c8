"""What moves by itself is masked, what stands still is not; a run does it in two passes."""

import dataclasses
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from people import make_people, paste_people
from refusals import refused
from tiny_run import SETTINGS, Case, computed_stages

from gsba import refine
from gsba.camera.rig import CubeRig
from gsba.camera.sphere import erp_from_bearings
from gsba.disk import write_image
from gsba.evaluate.trajectory import evaluate
from gsba.frames import cut, scan
from gsba.frames.masks import levels_of, load_mask, load_weights
from gsba.frames.pixels import load_erp
from gsba.frames.recordings import combine
from gsba.geometry import unit
from gsba.masks.distractors import StaticScene, distractor_mask, distractor_weights
from gsba.masks.merging import choose
from gsba.store.store import load_stage
from gsba.trajectory.files import read_trajectory
from gsba.types import FACES, Counts, FrameSet, Landmarks, Solution, Tracks

UP = np.array([0.0, -1.0, 0.0])  # of the gallery


def _populated(case: Case, folder: Path) -> tuple[FrameSet, np.ndarray]:
    """The tiny walk with people in front of it, and where they are, (F, H, 2H) bool."""
    frames, poses = case.result.frames, case.truth.world_T_rigs
    people = make_people(poses, 2, 1.6, UP, seed=1)
    folder.mkdir()
    outlines = []
    for f, name in enumerate(frames.names):
        image, outline = paste_people(load_erp(frames, f), poses[f], people, f)
        write_image(folder / f"{name}.png", image)
        outlines.append(outline)
    rows = zip(frames.names, frames.timestamps.tolist(), strict=True)
    (folder / "timestamps.csv").write_text("\n".join(f"{n}.png,{t!r}" for n, t in rows))
    paths = tuple((folder / f"{name}.png",) for name in frames.names)
    return dataclasses.replace(frames, paths=paths), np.stack(outlines)


@pytest.fixture(scope="module")
def populated(case: Case, tmp_path_factory: pytest.TempPathFactory) -> tuple[FrameSet, np.ndarray]:
    return _populated(case, tmp_path_factory.mktemp("populated") / "people")


def _scene(case: Case, frames: FrameSet, known=None) -> StaticScene:
    solved = load_stage(case.out, "refined1", Solution)
    return StaticScene(frames, solved.world_T_rigs, solved.landmarks, known)


@pytest.mark.slow
def test_people_are_found_and_nothing_else(case: Case, populated) -> None:
    frames, true = populated
    assert 0.01 < true.mean() < 0.1
    first = _scene(case, frames)
    once = [distractor_mask(first.find(f)) for f in range(len(frames))]
    again = _scene(case, frames, lambda f: once[f])
    found = np.stack([distractor_mask(again.find(f)) for f in range(len(frames))])
    assert found.shape == true.shape and found.dtype == bool
    assert np.sum(found & true) >= 0.8 * np.sum(true)
    assert np.mean((found & ~true)[:-1]) <= 0.01  # the last one has witnesses on one side only
    # Without what the first look found among its witnesses, more of them is seen.
    assert np.sum(found & true) > np.sum(np.stack(once) & true)
    clean = _scene(case, case.result.frames)
    shares = [clean.find(f).share for f in (1, 4, 6)]
    assert np.mean(shares) <= 0.01


def test_frames_that_cannot_be_judged_are_left_alone(case: Case) -> None:
    """Too few points in common."""
    frames = case.result.frames
    solved = load_stage(case.out, "refined1", Solution)
    tracks = solved.landmarks.tracks
    few = dataclasses.replace(solved.landmarks, points_world=solved.landmarks.points_world[:5])
    kept = tracks.points < 5
    few_tracks = dataclasses.replace(
        tracks,
        points=tracks.points[kept],
        frames=tracks.frames[kept],
        keypoints=tracks.keypoints[kept],
        num_points=5,
    )
    few = dataclasses.replace(few, tracks=few_tracks)
    alone = StaticScene(frames, solved.world_T_rigs, few).find(3)
    assert "too few frames" in alone.reason and not distractor_mask(alone).any()


def test_what_is_masked_already_is_not_judged(case: Case, populated, tmp_path: Path) -> None:
    frames, true = populated
    write_image(tmp_path / "own.png", np.where(true[2], 0, 255).astype(np.uint8))
    masks = [tmp_path / "own.png" if f == 2 else None for f in range(len(frames))]
    scene = _scene(case, dataclasses.replace(frames, mask_paths=tuple(masks)))
    found = distractor_mask(scene.find(2))
    assert not (found & true[2]).any() and found.mean() < 0.02


@pytest.mark.slow
def test_a_run_masks_people_in_a_second_pass(case: Case, tmp_path: Path) -> None:
    """The given mask is kept, no observation is masked, and the second call resumes it all."""
    frames, true = _populated(case, tmp_path / "people")
    given = np.full(true.shape[1:], 255, np.uint8)
    given[-20:] = 0
    write_image(tmp_path / "given.png", given)
    masks = [tmp_path / "given.png", "distractors"]

    def run():
        return refine(tmp_path / "people", case.slam, tmp_path / "run", SETTINGS, masks=masks)

    result = run()
    seen = erp_from_bearings(
        result.reconstruction.observation_bearings, frames.format.width, frames.format.height
    )
    columns, rows = np.minimum(
        seen.astype(int), [frames.format.width - 1, frames.format.height - 1]
    ).T
    kept = [load_mask(result.frames, f) for f in range(len(frames))]
    used = np.stack([mask for mask in kept if mask is not None])
    assert used[result.reconstruction.observation_frames, rows, columns].mean() > 0.999
    hidden, true = ~used[:, :-20], true[:, :-20]
    assert not used[:, -20:].any() and np.sum(hidden & true) >= 0.5 * np.sum(hidden | true)
    assert (tmp_path / "run/masks_check.jpg").exists()
    assert len(list((tmp_path / "run/colmap/masks").rglob("*.png"))) == 6 * len(frames)
    wrote = json.loads((tmp_path / "run/gsba.json").read_text())["wrote"]
    assert f"masks/{frames.names[0]}.png" in wrote
    stages = [stage["name"] for stage in result.report["stages"]]
    assert stages.index("first-refined1") < stages.index("distractors") < stages.index("features")
    errors = evaluate(read_trajectory(tmp_path / "run/trajectory.tum"), case.truth)
    start = evaluate(read_trajectory(case.slam), case.truth)
    assert errors.ate.rmse < 0.1 * start.ate.rmse  # masks are for splats: poses hardly gain
    assert computed_stages(run()) == []


def test_panoramas_and_cube_faces_are_compared_by_grey_levels(tmp_path: Path) -> None:
    """Of one place: a thing that one frame alone shows is found in either, by shards too."""
    rng, recordings = np.random.default_rng(0), {}
    plain = cv2.GaussianBlur(rng.integers(0, 255, (128, 256, 3), np.uint8), (0, 0), 3.0)
    thing = plain.copy()
    thing[44:84, 30:60] = 255 - plain[44:84, 30:60] // 4  # in the left face
    rig = CubeRig(64, np.pi / 2)
    for name in ("panoramas", "faces"):
        for n, picture in enumerate([thing, plain, plain, plain]):
            if name == "panoramas":
                write_image(tmp_path / name / f"{n}.png", picture)
            else:
                for face, image in zip(FACES, cut(picture, rig), strict=True):
                    write_image(tmp_path / name / face / f"{n}.png", image)
        recordings[name] = scan(tmp_path / name, fps=1.0)
    frames = combine(recordings)
    num, points = len(frames), 3 * unit(rng.normal(size=(60, 3)))
    poses = np.tile(np.eye(4), (num, 1, 1))
    poses[:, 0, 3] = 1e-3 * np.arange(num)
    each, of = np.repeat(np.arange(60), num), np.tile(np.arange(num), 60)
    tracks = Tracks(each.astype(np.int32), of.astype(np.int32), each.astype(np.int32), 60)
    scene = StaticScene(frames, poses, Landmarks(points, tracks, Counts(60, 60, "tracks")))
    for f in range(num):
        found = scene.find(f)
        assert not found.reason
        place = distractor_mask(found)[50:78, 36:54].mean()
        assert place > 0.9 if f in (0, 4) else place == 0
        part, number = scene.taken([f])
        np.testing.assert_array_equal(part.find(number[f]).weights, found.weights)


def test_masks_are_chosen_by_name(tmp_path: Path) -> None:
    both = choose([tmp_path, "auto", "distractors"])
    assert both.given == tmp_path and both.carrier and both.distractors
    one = choose("carrier")
    assert one.given is None and one.carrier and not one.distractors
    assert choose(None) == choose([]) and choose(str(tmp_path)).given == tmp_path
    refused("give one file or one folder", choose, [tmp_path, "other.png"])


def test_weights_are_written_as_grey_levels(tmp_path: Path, case: Case) -> None:
    """Grey above 127 weighs, the rest is masked; the two ways of reading agree."""
    frames = case.result.frames
    weights = np.linspace(0, 1, frames.format.width)[None] * np.ones((frames.format.height, 1))
    write_image(tmp_path / "grey.png", levels_of(weights))
    masked = dataclasses.replace(frames, mask_paths=(tmp_path / "grey.png",) * len(frames))
    mask, found = load_mask(masked, 0), load_weights(masked, 0)
    assert mask is not None and found is not None and found.dtype == np.float32
    np.testing.assert_array_equal(found > 0, mask)
    np.testing.assert_array_equal(mask, weights > 0)
    assert np.abs(found - weights).max() <= 1 / 128
    assert load_weights(frames, 0) is None
    np.testing.assert_array_equal(levels_of(mask), np.where(mask, 255, 0))


def test_what_fits_badly_weighs_less(case: Case, populated) -> None:
    """What is left of people beside the mask is trusted less than the rest of the picture."""
    frames, true = populated
    scene = _scene(case, frames)
    missed, scenery = [], []
    for f in range(1, len(frames), 3):
        found = scene.find(f)
        weights, left = distractor_weights(found), ~distractor_mask(found)
        missed.append(weights[true[f] & left])
        scenery.append(weights[~true[f] & left])
    assert np.concatenate(missed).mean() < 0.75 * np.concatenate(scenery).mean()
    assert np.concatenate(scenery).mean() > 0.8
