"""What carries the camera: found on walks where it is pasted in, and nowhere else."""

import dataclasses
import json
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from command import run_gsba, succeed
from refusals import refused
from scipy.spatial.transform import Rotation
from tiny_run import PLAIN, Case, computed_stages, settings_with
from two_fisheyes import colours, made_pair, picture, write

from gsba import refine
from gsba.camera.sphere import erp_directions, erp_from_bearings
from gsba.disk import write_image
from gsba.frames.scan import scan
from gsba.log import GsbaError
from gsba.masks.carrier import carrier_mask, find_carrier, write_carrier
from gsba.masks.merging import choose
from gsba.pipeline.acceptance import masked_scene_share
from gsba.types import FrameSet

WIDTH, HEIGHT, NUM = 512, 256, 12


def _outline() -> np.ndarray:
    """A bag around the nadir, over the seam, and a stick that leans out of it, (H, W) bool."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    longitude = (u / WIDTH - 0.5) * 2 * np.pi
    bag = v > HEIGHT * (0.86 + 0.03 * np.sin(3 * longitude + 1))
    stick = np.abs(longitude - 0.7 - 0.4 * (v / HEIGHT - 0.7)) < 0.06
    return bag | (stick & (v > 0.68 * HEIGHT))


@cache
def _box(plain_floor: bool, speed: float) -> list[np.ndarray]:
    """Panoramas (H, W, 3) float of a walk through a textured box."""
    images = []
    for f in range(NUM):
        centre = np.array([speed * f - 1.7, 0.1 * np.sin(f), 0.3 * np.cos(f)])
        image, floor = _inside_box(centre, erp_directions(WIDTH))
        if plain_floor:
            image[floor] = (150, 140, 130)
        images.append(image)
    return images


def _inside_box(centre: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Colours (H, W, 3) of the walls that rays (H, W, 3) from a point meet, and where they are the
    floor."""
    noise = cv2.GaussianBlur(np.random.default_rng(0).normal(size=(256, 256, 3)), (0, 0), 2.5)
    texture = np.clip(128 + 45 * noise / noise.std(), 0, 255).astype(np.float32)
    walls = np.array([4.0, 1.6, 3.0])
    steps = (np.sign(rays) * walls - centre) / np.where(np.abs(rays) < 1e-9, 1e-9, rays)
    axis = np.argmin(steps, axis=-1)
    hit = centre + np.min(steps, axis=-1)[..., None] * rays
    across = np.take_along_axis(hit, np.stack([(axis + 1) % 3, (axis + 2) % 3], -1), axis=-1)
    at = (across * 40 + 1000 + 70 * axis[..., None]).astype(np.float32) % 255
    image = cv2.remap(texture, at[..., 0], at[..., 1], cv2.INTER_LINEAR)
    return image, (axis == 1) & (rays[..., 1] > 0)


def _walk(folder: Path, look: np.ndarray | None, plain_floor: bool = False, speed: float = 0.25):
    """Panoramas inside the box, `look` pasted in front; exposure breathes by 6%, with noise."""
    rng, mask = np.random.default_rng(0), _outline()
    for f, seen in enumerate(_box(plain_floor, speed)):
        image = seen.copy()
        if look is not None:
            image[mask] = look[mask]
        image = image * (1 + 0.06 * np.sin(1.7 * f)) + rng.normal(0, 2, image.shape)
        write_image(folder / f"{f:03d}.png", np.clip(image, 0, 255).astype(np.uint8))
    return scan(folder, order_suffices=True)


def _looks() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(1)
    cells = rng.uniform(0, 255, (HEIGHT // 8, WIDTH // 8, 3)).astype(np.float32)
    twice = cv2.resize(np.tile(cells, (1, 2, 1)), (2 * WIDTH, HEIGHT))
    texture = twice[:, WIDTH // 2 : WIDTH // 2 + WIDTH]  # its edges meet
    return {"dark": 10 + 0.15 * texture, "bright": 205 + 0.1 * texture, "coloured": texture}


def _overlap(found: np.ndarray, true: np.ndarray) -> float:
    """Intersection over union on the sphere's picture."""
    return float(np.sum(found & true) / np.sum(found | true))


@pytest.mark.parametrize(
    ("look", "plain_floor"), [("dark", True), ("bright", False), ("coloured", True)]
)
def test_a_pasted_carrier_is_found(tmp_path: Path, look: str, plain_floor: bool) -> None:
    carrier = find_carrier(_walk(tmp_path, _looks()[look], plain_floor))
    assert _overlap(~carrier.mask, _outline()) >= 0.9
    assert carrier.reason == "" and carrier.share == np.mean(~carrier.mask)


@pytest.mark.parametrize("plain_floor", [False, True])
def test_without_a_carrier_everything_is_used(tmp_path: Path, plain_floor: bool) -> None:
    """A floor without texture stays fixed too, but has no outline."""
    carrier = find_carrier(_walk(tmp_path, None, plain_floor))
    assert carrier.mask.all() and carrier.share == 0 and carrier.reason


@pytest.mark.parametrize("look", ["dark", "coloured"])
def test_a_carrier_that_turns_below_the_picture_is_found(tmp_path: Path, look: str) -> None:
    """As with direction lock: each frame has its own turn, and its own mask."""
    frames, image, mask = _walk(tmp_path / "frames", None), _looks()[look], _outline()
    rng = np.random.default_rng(3)
    turns = np.round(np.cumsum(rng.normal(0, 30, len(frames)))).astype(int)  # columns
    for turn, (path,) in zip(turns, frames.paths, strict=True):
        pasted, outline = np.roll(image, turn, axis=1), np.roll(mask, turn, axis=1)
        picture = cv2.imread(str(path))[..., ::-1].copy()
        noisy = pasted[outline] + rng.normal(0, 2, pasted[outline].shape)
        picture[outline] = np.clip(noisy, 0, 255)
        write_image(path, picture)
    carrier = find_carrier(frames)
    found = [~carrier_mask(carrier, frames.format, f) for f in range(len(frames))]
    for f, turn in enumerate(turns):
        assert _overlap(found[f], np.roll(mask, turn, axis=1)) >= 0.9
    written = write_carrier(carrier, frames, tmp_path / "m")
    assert len(written) == 2 + len(frames)
    merged = scan(tmp_path / "frames", masks=tmp_path / "m/merged", order_suffices=True)
    last = cv2.imread(str(merged.mask_paths[-1]), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(last == 0, found[-1])


def _head() -> np.ndarray:
    """Something at the horizon, over the seam, with an arm that hangs from it, (H, W) bool."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    across = (u + 10) % WIDTH - 40
    head = (across / 30) ** 2 + ((v - 120) / 35) ** 2 < 1
    return head | ((np.abs(across - 12 - (v - 150) / 4) < 9) & (v > 140) & (v < 215))


@cache
def _worlds() -> list[np.ndarray]:
    """Panoramas (H, W, 3) float of worlds that have nothing in common."""
    rng, images = np.random.default_rng(5), []
    for _ in range(12):
        noise = np.tile(rng.normal(size=(HEIGHT, WIDTH, 3)), (1, 2, 1))  # its edges meet
        world = np.roll(cv2.GaussianBlur(noise, (0, 0), 3), -WIDTH // 2, 1)[:, :WIDTH]
        images.append(np.clip(128 + 45 * world / world.std(), 0, 255))
    return images


def _noise_frames(folder: Path, mask: np.ndarray, look: np.ndarray) -> FrameSet:
    """Panoramas of a world that is new in every frame, with `look` where `mask`."""
    rng = np.random.default_rng(6)
    for f, world in enumerate(_worlds()):
        image = world.copy()
        image[mask] = look[mask] + rng.normal(0, 2, look[mask].shape)
        write_image(folder / f"{f:03d}.png", np.clip(image, 0, 255).astype(np.uint8))
    return scan(folder, order_suffices=True)


@pytest.mark.parametrize("look", ["dark", "coloured"])
def test_what_turns_with_the_camera_is_found_at_the_horizon(tmp_path: Path, look: str) -> None:
    carrier = find_carrier(_noise_frames(tmp_path, _head(), _looks()[look]))
    assert _overlap(~carrier.mask, _head()) >= 0.85 and not carrier.turns.any()


def test_a_moving_world_alone_masks_nothing(tmp_path: Path) -> None:
    nothing = np.zeros((HEIGHT, WIDTH), bool)
    carrier = find_carrier(_noise_frames(tmp_path, nothing, _looks()["dark"]))
    assert carrier.mask.all() and carrier.reason == "nothing turns with the camera"


def test_a_rail_that_moves_along_itself_is_not_the_carrier(tmp_path: Path) -> None:
    """A straight edge at the height of the camera stays where it is while the world moves."""
    v, _ = np.mgrid[:HEIGHT, :WIDTH]
    rail = np.abs(v - HEIGHT / 2) < 6
    carrier = find_carrier(_noise_frames(tmp_path, rail, np.full((HEIGHT, WIDTH, 3), 20.0)))
    assert carrier.mask.all()


def test_areas_without_pixels_do_not_ride_along(tmp_path: Path) -> None:
    """A crop of 270 x 135 degrees, padded with black, is no vehicle."""
    outside = np.ones((HEIGHT, WIDTH), bool)
    outside[HEIGHT // 8 : -HEIGHT // 8, WIDTH // 8 : -WIDTH // 8] = False
    frames = _noise_frames(tmp_path, outside, np.full((HEIGHT, WIDTH, 3), -50.0))
    carrier = find_carrier(frames)
    assert carrier.mask.all() and carrier.reason == "nothing turns with the camera"
    mask_paths = (tmp_path / "m" / "mask.png",) * NUM
    write_image(mask_paths[0], np.where(outside, 0, 255).astype(np.uint8))
    assert masked_scene_share(dataclasses.replace(frames, mask_paths=mask_paths)) < 0.01


def test_a_vehicle_that_fills_the_view_is_said(tmp_path: Path) -> None:
    v, _ = np.mgrid[:HEIGHT, :WIDTH]
    frames = _noise_frames(tmp_path / "car", v > 0.3 * HEIGHT, _looks()["coloured"])
    refused("most of the picture is a vehicle", find_carrier, frames)


def test_what_cannot_be_told_is_refused(tmp_path: Path, case: Case) -> None:
    standing = _walk(tmp_path / "standing", _looks()["dark"], speed=0.0)
    first = standing.paths[0][0].read_bytes()
    for (path,) in standing.paths:
        path.write_bytes(first)
    refused("the camera must move", find_carrier, standing)
    few = dataclasses.replace(
        standing, names=standing.names[:5], paths=standing.paths[:5], timestamps=np.arange(5.0)
    )
    refused("5 frames are too few", find_carrier, few)
    faces = dataclasses.replace(standing.format, layout="cube")
    with pytest.raises(GsbaError, match="these frames are cube faces"):
        find_carrier(dataclasses.replace(standing, formats=(faces,)))


def test_command_writes_what_can_be_looked_at(tmp_path: Path) -> None:
    frames = _walk(tmp_path / "frames", _looks()["dark"])
    own = np.full((HEIGHT, WIDTH), 255, np.uint8)
    own[:40] = 0
    cv2.imwrite(str(tmp_path / "own.png"), own)
    arguments = ["mask", frames.paths[0][0].parent, "--out", tmp_path / "m"]
    result = succeed(*arguments, "--masks", tmp_path / "own.png")
    assert "% of the image" in result.stdout
    found = cv2.imread(str(tmp_path / "m/carrier.png"), cv2.IMREAD_UNCHANGED)
    assert set(np.unique(found)) == {0, 255} and _overlap(found == 0, _outline()) >= 0.9
    assert cv2.imread(str(tmp_path / "m/carrier_check.jpg")).shape == (HEIGHT, WIDTH, 3)
    merged = scan(frames.paths[0][0].parent, masks=tmp_path / "m/merged", order_suffices=True)
    both = cv2.imread(str(merged.mask_paths[3]), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(both > 0, (found > 0) & (own > 0))
    bad = run_gsba("mask", tmp_path / "nowhere", "--out", tmp_path / "n")
    assert bad.exit_code == 1 and "no such file or folder" in bad.stderr


def test_refine_leaves_the_carrier_out(case: Case, tmp_path: Path) -> None:
    """Pasted into a rendered walk: no feature on it, a mask in the export, and it resumes."""
    walk, mask = case.result.frames, _outline()
    look = _looks()["coloured"][..., ::-1]
    (tmp_path / "frames").mkdir()
    for (path,) in walk.paths:
        image = cv2.imread(str(path)).astype(np.float32)
        image[mask] = look[mask]
        cv2.imwrite(str(tmp_path / "frames" / path.name), image)
    times = [
        f"{path.name},{t!r}"
        for (path,), t in zip(walk.paths, walk.timestamps.tolist(), strict=True)
    ]
    (tmp_path / "frames/timestamps.csv").write_text("\n".join(times))
    settings = settings_with(patches={"rounds": 0})
    result = refine(tmp_path / "frames", case.slam, tmp_path / "run", settings, masks="carrier")
    found = cv2.imread(str(tmp_path / "run/carrier.png"), cv2.IMREAD_UNCHANGED) == 0
    assert _overlap(found, mask) >= 0.9
    seen = erp_from_bearings(result.reconstruction.observation_bearings, WIDTH, HEIGHT)
    columns, rows = np.minimum(seen.astype(int), [WIDTH - 1, HEIGHT - 1]).T
    assert not found[rows, columns].any()
    assert len(list((tmp_path / "run/colmap/masks").rglob("*.png"))) == 6 * len(walk)
    assert "carrier.png" in json.loads((tmp_path / "run/gsba.json").read_text())["wrote"]
    again = refine(tmp_path / "frames", case.slam, tmp_path / "run", settings, masks="carrier")
    assert computed_stages(again) == []


def test_masks_are_looked_for_by_default_and_can_be_turned_off(
    case: Case, plain_run: Path, tmp_path: Path
) -> None:
    """Where there is no carrier, looking for it changes no pose and leaves no file."""
    case.refine(tmp_path / "none", PLAIN, masks="none")
    reports = [
        json.loads((run / "report.json").read_text()) for run in (tmp_path / "none", plain_run)
    ]
    stages = [{stage["name"] for stage in report["stages"]} for report in reports]
    assert "carrier" not in stages[0] and "carrier" in stages[1]
    assert not any((plain_run / name).exists() for name in ("carrier.png", "masks"))
    poses = (plain_run / "trajectory.tum").read_bytes()
    assert (tmp_path / "none/trajectory.tum").read_bytes() == poses


def test_masks_none_stands_alone() -> None:
    assert not choose("none").carrier and choose("auto").carrier
    refused("turns masks off", choose, ["none", "distractors"])


def test_raw_pairs_are_taken(tmp_path: Path) -> None:
    """Something before the front lens stays in its pictures."""
    pair = made_pair()
    ahead = Rotation.from_rotvec(pair[0].rotation).as_matrix()[:, 2]
    for f, turn in enumerate(Rotation.from_rotvec(np.random.default_rng(1).normal(0, 2, (8, 3)))):
        for name, lens in zip(("front", "back"), pair, strict=True):

            def seen(directions: np.ndarray, turn: Rotation = turn) -> np.ndarray:
                near = (directions @ ahead > np.cos(0.5))[..., None]
                return np.where(
                    near, colours(2 * directions), colours(directions @ turn.as_matrix())
                )

            write(tmp_path / "raw" / name / f"{f}.png", picture(lens, seen))
    arguments = ["mask", str(tmp_path / "raw"), "--out", str(tmp_path / "m")]
    succeed(*arguments)
    found = cv2.imread(str(tmp_path / "m/carrier.png"), cv2.IMREAD_UNCHANGED) == 0
    height, width = found.shape
    cone = erp_directions(width)[..., 2] > np.cos(0.5)
    assert width == 2 * height and _overlap(found, cone) >= 0.8


def test_a_camera_that_turns_is_no_carrier_that_turns(tmp_path: Path) -> None:
    """On the spot, the floor turns like a carrier below a picture that keeps its heading."""
    (first, *_), *_ = _walk(tmp_path / "walk", None, speed=0.0).paths
    rng, picture = np.random.default_rng(2), cv2.imread(str(first)).astype(np.float32)
    for f in range(NUM):
        turned = np.roll(picture, 41 * f, axis=1)
        near = cv2.GaussianBlur(rng.normal(0, 60, turned.shape), (0, 0), 3.0)  # people around
        turned[90:140, 200:360] += 5 * near[90:140, 200:360]
        noisy = np.clip(turned + rng.normal(0, 2, turned.shape), 0, 255).astype(np.uint8)
        write_image(tmp_path / f"turn/{f:03d}.png", noisy)
    carrier = find_carrier(scan(tmp_path / "turn", order_suffices=True))
    assert carrier.mask.all() and not carrier.turns.any()


def test_a_camera_that_sways_on_the_spot_shows_no_carrier(tmp_path: Path) -> None:
    """The hand turns it by a few degrees; the room stays once that is undone, and is no vehicle."""
    rng, rays = np.random.default_rng(0), erp_directions(WIDTH)
    turns = Rotation.from_rotvec(np.radians(rng.normal(0, [1.5, 2.5, 1.5], (NUM, 3))))
    for f, (turn, centre) in enumerate(zip(turns, rng.normal(0, 0.05, (NUM, 3)), strict=True)):
        image, _ = _inside_box(centre, rays @ turn.as_matrix().T)
        write_image(tmp_path / f"sway/{f:03d}.png", image.astype(np.uint8))
    carrier = find_carrier(scan(tmp_path / "sway", order_suffices=True))
    assert carrier.mask.all() and not carrier.turns.any()
