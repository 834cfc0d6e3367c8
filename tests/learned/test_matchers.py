"""Learned matchers: every extractor with every matcher, on geometry that is known."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from learned_networks import (
    EXTRACTORS,
    OfficialSuperGlue,
    kornia_feature,
    lightglue,
    official_lightglue,
    save_extractors,
    save_transparent_matcher,
    torch,
)
from refusals import refused
from scipy.spatial.transform import Rotation
from synthetic import RIG as FULL
from synthetic import features_of, unit

from gsba.camera.rig import CubeRig
from gsba.config import RefineSettings
from gsba.features import detection
from gsba.features.detection import traits_of
from gsba.geometry import pose
from gsba.learned import FaceMatcher, LearnedExtractor, make_matcher, overlapping_faces
from gsba.learned.lightglue import LightGlue
from gsba.matching import guided_search
from gsba.matching.guided_search import Gate, SearchableFrames, guided
from gsba.store.shards import Threads
from gsba.types import FACES, Features

if TYPE_CHECKING:
    from gsba.learned.magicleap import SuperGlue

RIG = CubeRig(96, np.deg2rad(96))
COMBINATIONS = [
    *((extractor, matcher) for extractor in EXTRACTORS for matcher in ("guided", "lightglue")),
    ("superpoint", "superglue"),
]
TURN = pose(Rotation.from_rotvec([0, np.pi / 2, 0]).as_matrix(), np.zeros(3))  # a face to the right
GATE = Gate(np.deg2rad(0.5), 0.01, np.deg2rad(1))
SEES = {"front": "right", "right": "back", "back": "left", "left": "front"}  # frame 1 -> frame 0


@pytest.fixture(autouse=True)
def few_layers(monkeypatch: pytest.MonkeyPatch) -> None:
    """LightGlue with three of its nine layers: its files are made, saved and loaded faster."""
    monkeypatch.setitem(kornia_feature.LightGlue.default_conf, "n_layers", 3)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("weights")


@pytest.fixture(scope="module")
def extractors(folder: Path) -> dict[str, Path]:
    return save_extractors(folder)


@pytest.fixture(scope="module")
def matcher_file(folder: Path) -> Callable[[str, str], Path]:
    """Makes the file of a matcher (name, extractor), once."""
    return cache(partial(save_transparent_matcher, folder))


@pytest.fixture(scope="module")
def seen(extractors: dict[str, Path]) -> Callable[[str], tuple[Features, ...]]:
    """Two frames at one place, the second turned to the right by one face, by extractor."""
    rng = np.random.default_rng(0)
    faces = rng.integers(0, 256, (6, RIG.size, RIG.size, 3)).astype(np.uint8)
    turned = faces.copy()
    for face, source in SEES.items():
        turned[FACES.index(face)] = faces[FACES.index(source)]
    around = np.zeros((6, RIG.size, RIG.size), bool)
    around[: len(SEES)] = True  # above and below, images turn too, and no network follows that

    def see(name: str) -> tuple[Features, ...]:
        extractor = LearnedExtractor(_settings(name).features, extractors[name])
        views = (faces, turned)
        return tuple(detection.extract(view, around, RIG, extractor) for view in views)

    return cache(see)


def _settings(extractor: str, matcher: str = "guided") -> RefineSettings:
    chosen = {"extractor": extractor, "max_per_face": 60}
    return RefineSettings.model_validate({"features": chosen, "matching": {"matcher": matcher}})


def _frames(found: tuple[Features, ...], strongest: int | None = None) -> SearchableFrames:
    return SearchableFrames(found.__getitem__, strongest)


@pytest.mark.parametrize(("extractor", "matcher"), COMBINATIONS)
def test_contract(
    seen: Callable[[str], tuple[Features, ...]],
    matcher_file: Callable[[str, str], Path],
    extractor: str,
    matcher: str,
) -> None:
    """What both frames see is matched to itself, once each, the same way every time, by threads
    too; and a prediction that excludes it leaves nothing."""
    settings, found = _settings(extractor, matcher), seen(extractor)
    weights = {} if matcher == "guided" else {"matching": matcher_file(matcher, extractor)}
    compare = make_matcher(settings, weights, RIG)
    poses = np.array([np.eye(4), TURN])

    def match(
        poses: np.ndarray, strongest: int | None = None, num: int = 1
    ) -> guided_search.Matches:
        pairs, frames = np.array([[0, 1]] * num), _frames(found, strongest)
        how = traits_of(settings), Threads(num)
        return guided_search.match(pairs, poses, [GATE] * num, frames, *how, matcher=compare)

    matched = match(poses, num=2)
    rows = matched.of(0)
    np.testing.assert_array_equal(rows, matched.of(1))
    np.testing.assert_array_equal(rows, match(poses).of(0))
    assert rows.dtype == np.int32 and len(rows) > 0.9 * len(found[0])
    assert all(len(np.unique(column)) == len(rows) for column in rows.T)
    there = found[1].bearings_rig[rows[:, 1]] @ TURN[:3, :3].T
    np.testing.assert_allclose(found[0].bearings_rig[rows[:, 0]], there, atol=1e-6)
    few = match(poses, 10).of(0)
    assert 30 < len(few) <= 40 and set(map(tuple, few)) <= set(map(tuple, rows))
    aside = np.array([np.eye(4), pose(Rotation.from_rotvec([0, 1.65, 0]).as_matrix(), [0, 0, 0])])
    wrong = match(aside).of(0)  # 4.5 degrees off, 1.5 allowed
    assert not np.isin(rows[:, 0] * 10_000 + rows[:, 1], wrong @ [10_000, 1]).any()


def _shown(found: tuple[Features, Features], f0_T_f1: np.ndarray, gate: Gate = GATE) -> list[tuple]:
    """Keypoints of both faces that the network gets."""
    shown = []

    def network(first, second, size):
        shown.append((first, second, size))
        return np.zeros((0, 2), int), np.zeros(0)

    FaceMatcher(network, FULL)(_frames(found), (0, 1), f0_T_f1, gate, _settings("sift").matching)
    return shown


def _asked(
    found: tuple[Features, Features], f0_T_f1: np.ndarray, gate: Gate = GATE
) -> tuple[list[tuple[str, str]], list[tuple]]:
    """Pairs of faces that the network was shown, in order, and what it was shown."""
    shown = _shown(found, f0_T_f1, gate)
    names = [
        tuple(
            FACES[int(view.faces[np.isclose(view.pixels, side.pixels[0]).all(axis=1)][0])]
            for view, side in zip(found, call[:2], strict=True)
        )
        for call in shown
    ]
    return names, shown


def _all_around(seed: int, num: int = 1200) -> Features:
    rng = np.random.default_rng(seed)
    bearings = unit(rng.normal(size=(num, 3)))
    found = features_of(bearings, rng.normal(size=(num, 8)).astype(np.float32))
    order = np.argsort(found.faces, kind="stable")
    return features_of(bearings[order], unit(found.descriptors[order]))


def test_only_faces_that_should_overlap_are_compared() -> None:
    views = _all_around(0), _all_around(1)
    assert set(_asked(views, TURN)[0]) == {
        *((there, here) for here, there in SEES.items()),
        ("up", "up"),
        ("down", "down"),
    }
    half = pose(Rotation.from_rotvec([0, np.pi / 4, 0]).as_matrix(), np.zeros(3))
    asked = _asked(views, half)[0]
    assert ("front", "front") in asked and ("right", "front") in asked
    assert ("back", "front") not in asked and ("front", "right") not in asked


def test_without_a_prediction_sides_that_are_alike_are_compared() -> None:
    first = _all_around(0)
    turned = features_of(first.bearings_rig @ TURN[:3, :3], first.descriptors)
    order = np.argsort(turned.faces, kind="stable")
    second = features_of(turned.bearings_rig[order], turned.descriptors[order])
    asked = _asked((first, second), np.eye(4), Gate.anywhere())[0]
    pairs = [*((there, here) for here, there in SEES.items()), ("up", "up"), ("down", "down")]
    assert sorted(asked) == sorted(pairs)
    other = replace(second, descriptors=_all_around(1).descriptors)  # chance: any may overlap
    assert len(_asked((first, other), np.eye(4), Gate.anywhere())[0]) == 9


def test_descriptors_of_another_length_are_one_line(
    matcher_file: Callable[[str, str], Path],
) -> None:
    short = detection.FaceKeypoints(np.full((9, 2), 5.0), np.ones(9), np.ones((9, 64), np.float32))
    network = LightGlue("aliked", matcher_file("lightglue", "aliked"))
    refused(r"128 values, but features\.weights gives 64.*aliked-n16", network, short, short, 96)


def test_near_points_may_cross_to_the_next_face() -> None:
    """Walking ahead, what is near moves from the front towards the back, never the other way."""
    ahead = pose(np.eye(3), np.array([0, 0, 0.5]))
    asked = set(_asked((_all_around(0), _all_around(1)), ahead)[0])
    assert {(face, face) for face in FACES} <= asked
    assert {("front", "right"), ("right", "back"), ("front", "down"), ("down", "back")} <= asked
    assert not {("right", "front"), ("back", "right"), ("front", "back"), ("left", "right")} & asked


def test_overlap_asks_either_frame() -> None:
    """A face with few keypoints in sight of one with many counts by its own."""
    few = _all_around(3, 60)
    near = few.bearings_rig[few.bearings_rig[:, 2] > 0.9]
    found = overlapping_faces(near, _all_around(1).bearings_rig, np.eye(4))
    assert ("front", "front") in [(FACES[a], FACES[b]) for a, b in found]


def test_the_network_sees_keypoints_of_the_face_as_they_are() -> None:
    views = _all_around(0), _all_around(1)
    names, shown = _asked(views, TURN)
    first, second, size = shown[names.index(("right", "front"))]
    rows = np.flatnonzero(views[0].faces == FACES.index("right"))
    np.testing.assert_allclose(first.pixels, views[0].pixels[rows])
    np.testing.assert_array_equal(first.descriptors, views[0].descriptors[rows])
    assert len(second.pixels) == (views[1].faces == FACES.index("front")).sum()
    assert size == FULL.size


def _twins(num: int = 60) -> tuple[Features, Features, np.ndarray]:
    """Points around two places, each with a perfect copy ten degrees off its epipolar line."""
    rng = np.random.default_rng(5)
    step = np.array([0.5, 0.1, 0.2])
    points = rng.uniform(2, 6, (num, 1)) * unit(rng.normal(size=(num, 3)))
    there = unit(points - step)
    copies = unit(there + np.tan(np.deg2rad(10)) * unit(np.cross(step, points)))
    descriptors = np.repeat(np.eye(num, dtype=np.float32), 2, axis=0)[::2]
    both = np.concatenate([copies, there]), np.concatenate([descriptors, descriptors])
    return features_of(unit(points), descriptors), features_of(*both), step


def test_repeated_structure_is_refused() -> None:
    """A network that falls for the copies is believed only where the gate lets it."""
    first, second, step = _twins()
    num = len(first)

    def fooled(one, other, size):
        like = one.descriptors @ other.descriptors.T
        rows, columns = np.nonzero(like > 0.5)
        scores = np.where(columns < len(other.pixels) / 2, 0.9, 0.6)  # likes the copies better
        return np.column_stack([rows, columns]), scores

    matcher = FaceMatcher(fooled, RIG)
    views = _frames((first, second))
    gate = Gate(np.deg2rad(1), 0.01, np.deg2rad(60))
    settings = _settings("sift").matching
    rows = matcher(views, (0, 1), pose(np.eye(3), step), gate, settings)
    assert len(rows) > 0.5 * num and (rows[:, 1] == rows[:, 0] + num).all()
    blind = matcher(views, (0, 1), pose(np.eye(3), step), Gate(0.5, 1, np.pi), settings)
    assert (blind[:, 1] < num).mean() > 0.5  # what the gate is for


def test_known_points_gate_learned_matches_too() -> None:
    first, second, step = _twins()
    num = len(first)

    def network(one, other, size):
        rows = np.argwhere(one.descriptors @ other.descriptors.T > 0.5)
        return rows, np.ones(len(rows))

    points = 3 * first.bearings_rig
    points[::2] = np.nan
    gate = Gate(np.pi, 1.0, np.pi, np.deg2rad(8))
    given = _frames((first, second)), (0, 1), pose(np.eye(3), step), gate
    rows = FaceMatcher(network, RIG)(*given, _settings("sift").matching, points)
    assert len(rows) and (rows[:, 0] % 2 == 1).all()
    seen_at = unit(points[rows[:, 0]] - step)
    cosines = (seen_at * second.bearings_rig[rows[:, 1]]).sum(axis=1)
    assert (np.arccos(cosines) < gate.point_rad).all()
    assert num > len(rows)


@pytest.mark.parametrize(
    ("extractor", "num_layers"), [("aliked", 9), ("disk", 3), ("superpoint", 3), ("xfeat", 6)]
)
def test_lightglue_loads_the_authors_layout(
    extractor: str, num_layers: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same network as kornia's under kornia's own names, with all that adapts switched off."""
    monkeypatch.setitem(kornia_feature.LightGlue.default_conf, "n_layers", num_layers)
    torch.manual_seed(1)
    model = lightglue(extractor)
    assert model.conf.n_layers == num_layers
    own, official = tmp_path / "own.pth", tmp_path / "official.pth"
    torch.save(model.state_dict(), own)
    prefix = "matcher." if extractor == "xfeat" else ""
    state = official_lightglue(model.state_dict(), model.conf.n_layers, prefix)
    assert not state.keys() & {name for name in model.state_dict() if "attn" in name}
    torch.save(state, official)
    loaded = [LightGlue(extractor, path)._model for path in (own, official)]
    for name, value in model.state_dict().items():
        for other in loaded:
            torch.testing.assert_close(other.state_dict()[name], value)
    assert not loaded[0].training and not loaded[0].conf.flash
    assert loaded[0].conf.width_confidence == -1  # all keypoints
    assert loaded[0].conf.depth_confidence == (-1 if extractor == "xfeat" else 0.99)


def _face(seed: int, num: int, size: int, dim: int) -> detection.FaceKeypoints:
    rng = np.random.default_rng(seed)
    return detection.FaceKeypoints(
        rng.uniform(0, size, (num, 2)),
        np.full(num, 0.5),
        unit(rng.normal(size=(num, dim))).astype(np.float32),
        rng.uniform(0.1, 1, num).astype(np.float32),
    )


def test_lightglue_counts_pixels_from_the_first_centre(
    matcher_file: Callable[[str, str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    glue, given = LightGlue("aliked", matcher_file("lightglue", "aliked")), []
    answer = {"matches": [torch.tensor([[2, 1]])], "scores": [torch.tensor([0.5])]}
    monkeypatch.setattr(glue, "_model", lambda data: (given.append(data), answer)[1])
    face = _face(0, 5, 96, 128)
    face.pixels[0] = [0.1, 95.9]  # nearer to the border than a centre: LightGlue refuses beyond
    matched, scores = glue(face, face, 96)
    np.testing.assert_array_equal(matched, [[2, 1]])
    sent = given[0]["image0"]
    np.testing.assert_allclose(sent["keypoints"][0, 1:], face.pixels[1:] - 0.5, atol=1e-5)
    np.testing.assert_allclose(sent["keypoints"][0, 0], [0, 95])
    assert sent["image_size"].tolist() == [[96, 96]] and scores.tolist() == [0.5]


def test_lightglue_of_disk_is_known_by_its_unused_tensors(
    matcher_file: Callable[[str, str], Path], tmp_path: Path
) -> None:
    state = torch.load(matcher_file("lightglue", "disk"), weights_only=True)
    path = tmp_path / "disk_lightglue.pth"
    torch.save(state | {f"log_assignment.{n}.r": torch.ones(1) for n in range(9)}, path)
    LightGlue("disk", path)
    refused("weights of another network than aliked-lightglue", LightGlue, "aliked", path)


@pytest.fixture(scope="module")
def superglues(folder: Path) -> "tuple[OfficialSuperGlue, SuperGlue]":
    """The paper's network with random weights, and ours from its file."""
    from gsba.learned.magicleap import SuperGlue  # takes seconds, in each worker that collects

    torch.manual_seed(2)
    model = OfficialSuperGlue().eval()
    with torch.no_grad():
        for module in model.modules():  # norms that do something
            if isinstance(module, torch.nn.BatchNorm1d):
                module.running_mean.normal_(0, 0.1)
                module.running_var.uniform_(0.5, 1.5)
        model.final_proj.weight.mul_(30)  # decided enough to pass the threshold
    torch.save(model.state_dict(), folder / "superglue_of_the_paper.pth")
    return model, SuperGlue(folder / "superglue_of_the_paper.pth")


@pytest.mark.parametrize("num", [40, 25])
def test_superglue_is_that_of_the_paper(
    num: int, superglues: "tuple[OfficialSuperGlue, SuperGlue]"
) -> None:
    """Equal probabilities, also where one face has fewer keypoints and is padded to as many."""
    model, glue = superglues
    faces = _face(3, 40, 128, 256), _face(4, num, 128, 256)
    matched, scores = glue(*faces, 128)
    sides = [
        [
            torch.from_numpy(np.asarray(x, np.float32))
            for x in (f.pixels - 0.5, f.descriptors, f.scores)
        ]
        for f in faces
    ]
    with torch.inference_mode():
        likely = model(sides, 128).numpy()
    best = (likely == likely.max(axis=1, keepdims=True)) & (likely == likely.max(axis=0))
    sure = np.argwhere(best & (likely > 0.2 + 1e-4))
    assert len(sure) > 3 and set(map(tuple, sure)) <= set(map(tuple, matched))
    assert (likely[tuple(matched.T)] > 0.2 - 1e-4).all()
    np.testing.assert_allclose(scores, likely[tuple(matched.T)], atol=1e-4)


def test_wrong_weights_are_one_line(
    extractors: dict[str, Path], matcher_file: Callable[[str, str], Path]
) -> None:
    for extractor, matcher, path, usual in (
        ("aliked", "lightglue", extractors["aliked"], "aliked_lightglue"),
        ("disk", "lightglue", matcher_file("lightglue", "superpoint"), "disk_lightglue"),
        ("superpoint", "lightglue", matcher_file("lightglue", "aliked"), "superpoint_lightglue"),
        ("superpoint", "superglue", matcher_file("lightglue", "aliked"), "superglue_outdoor"),
    ):
        given = _settings(extractor, matcher), {"matching": path}, RIG
        refused(f"weights of another network than .*{usual}", make_matcher, *given)


def test_the_default_is_our_own_search() -> None:
    assert make_matcher(RefineSettings(), {}, RIG) is guided


@pytest.mark.parametrize(("extractor", "matcher"), [("sift", "lightglue"), ("disk", "superglue")])
def test_matchers_go_with_their_extractors(extractor: str, matcher: str) -> None:
    with pytest.raises(ValueError, match=r"needs features\.extractor = "):
        _settings(extractor, matcher)


def test_frames_of_another_run_are_shown_at_one_size() -> None:
    """Their keypoints were found, and stored, on faces of another size."""
    found, small = _all_around(1), CubeRig(FULL.size // 2, np.deg2rad(96))
    stored = replace(found, pixels=small.project(found.bearings_rig, found.faces))
    alike, shown = (_shown((found, other), np.eye(4)) for other in (found, stored))
    assert len(shown) == len(alike) >= 6
    for seen, same in zip(shown, alike, strict=True):
        for one, other in zip(seen[:2], same[:2], strict=True):
            np.testing.assert_allclose(one.pixels, other.pixels)
