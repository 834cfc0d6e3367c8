"""What carries the camera: found on walks where it is pasted in, and nowhere else."""

import dataclasses
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from tiny_run import SETTINGS, Case, computed_stages
from typer.testing import CliRunner

from gsba import refine
from gsba.camera.sphere import bearings_from_erp, erp_from_bearings
from gsba.cli import app
from gsba.disk import write_image
from gsba.frames.scan import find_panoramas
from gsba.log import GsbaError
from gsba.masks.carrier import carrier_mask, find_carrier, write_carrier

WIDTH, HEIGHT, NUM = 512, 256, 14


def _outline() -> np.ndarray:
    """A bag around the nadir, over the seam, and a stick that leans out of it, (H, W) bool."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    longitude = (u / WIDTH - 0.5) * 2 * np.pi
    bag = v > HEIGHT * (0.86 + 0.03 * np.sin(3 * longitude + 1))
    stick = np.abs(longitude - 0.7 - 0.4 * (v / HEIGHT - 0.7)) < 0.06
    return bag | (stick & (v > 0.68 * HEIGHT))


def _rays() -> np.ndarray:
    grid = np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), axis=-1) + 0.5
    return bearings_from_erp(grid, WIDTH, HEIGHT)


def _walk(folder: Path, look: np.ndarray | None, plain_floor: bool = False, speed: float = 0.25):
    """Panoramas inside a textured box that the camera walks through, `look` pasted in front.

    Exposure breathes by 6%, and there is noise.
    """
    rng = np.random.default_rng(0)
    noise = cv2.GaussianBlur(rng.normal(size=(256, 256, 3)), (0, 0), 2.5)
    texture = np.clip(128 + 45 * noise / noise.std(), 0, 255).astype(np.float32)
    rays, mask = _rays(), _outline()
    for f in range(NUM):
        centre = np.array([speed * f - 1.7, 0.1 * np.sin(f), 0.3 * np.cos(f)])
        walls = np.array([4.0, 1.6, 3.0])
        steps = (np.sign(rays) * walls - centre) / np.where(np.abs(rays) < 1e-9, 1e-9, rays)
        axis = np.argmin(steps, axis=-1)
        hit = centre + np.min(steps, axis=-1)[..., None] * rays
        across = np.take_along_axis(hit, np.stack([(axis + 1) % 3, (axis + 2) % 3], -1), axis=-1)
        at = (across * 40 + 1000 + 70 * axis[..., None]).astype(np.float32) % 255
        image = cv2.remap(texture, at[..., 0], at[..., 1], cv2.INTER_LINEAR)
        if plain_floor:
            image[(axis == 1) & (rays[..., 1] > 0)] = (150, 140, 130)
        image *= 1 + 0.06 * np.sin(1.7 * f)
        if look is not None:
            image[mask] = look[mask] * (1 + 0.06 * np.sin(1.7 * f))
        image += rng.normal(0, 2, image.shape)
        write_image(folder / f"{f:03d}.png", np.clip(image, 0, 255).astype(np.uint8))
    return find_panoramas(folder)


def _looks() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(1)
    cells = rng.uniform(0, 255, (HEIGHT // 8, WIDTH // 8, 3)).astype(np.float32)
    texture = cv2.resize(cells, (WIDTH, HEIGHT))
    return {"dark": 10 + 0.15 * texture, "bright": 205 + 0.1 * texture, "coloured": texture}


def _overlap(found: np.ndarray, true: np.ndarray) -> float:
    """Intersection over union on the sphere's picture."""
    return float(np.sum(found & true) / np.sum(found | true))


@pytest.mark.parametrize("plain_floor", [False, True])
@pytest.mark.parametrize("look", ["dark", "bright", "coloured"])
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
    found = [~carrier_mask(carrier, frames, f) for f in range(len(frames))]
    for f, turn in enumerate(turns):
        assert _overlap(found[f], np.roll(mask, turn, axis=1)) >= 0.9
    written = write_carrier(carrier, frames, tmp_path / "m")
    assert len(written) == 2 + len(frames)
    merged = find_panoramas(tmp_path / "frames", tmp_path / "m/merged")
    last = cv2.imread(str(merged.mask_paths[-1]), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(last == 0, found[-1])


def test_what_cannot_be_told_is_refused(tmp_path: Path, case: Case) -> None:
    standing = _walk(tmp_path / "standing", _looks()["dark"], speed=0.0)
    first = standing.paths[0][0].read_bytes()
    for (path,) in standing.paths:
        path.write_bytes(first)
    with pytest.raises(GsbaError, match="the camera must move"):
        find_carrier(standing)
    few = dataclasses.replace(
        standing, names=standing.names[:5], paths=standing.paths[:5], timestamps=np.arange(5.0)
    )
    with pytest.raises(GsbaError, match="5 frames do not tell"):
        find_carrier(few)
    with pytest.raises(GsbaError, match="these frames are cube faces"):
        find_carrier(dataclasses.replace(standing, layout="cube"))


def test_command_writes_what_can_be_looked_at(tmp_path: Path) -> None:
    frames = _walk(tmp_path / "frames", _looks()["dark"])
    own = np.full((HEIGHT, WIDTH), 255, np.uint8)
    own[:40] = 0
    cv2.imwrite(str(tmp_path / "own.png"), own)
    arguments = ["mask", frames.paths[0][0].parent, "--out", tmp_path / "m"]
    result = CliRunner().invoke(app, [*map(str, arguments), "--masks", str(tmp_path / "own.png")])
    assert result.exit_code == 0 and "% of the picture" in result.stdout
    found = cv2.imread(str(tmp_path / "m/carrier.png"), cv2.IMREAD_UNCHANGED)
    assert set(np.unique(found)) == {0, 255} and _overlap(found == 0, _outline()) >= 0.9
    assert cv2.imread(str(tmp_path / "m/carrier_check.jpg")).shape == (HEIGHT, WIDTH, 3)
    merged = find_panoramas(frames.paths[0][0].parent, tmp_path / "m/merged")
    both = cv2.imread(str(merged.mask_paths[3]), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(both > 0, (found > 0) & (own > 0))
    bad = CliRunner().invoke(app, ["mask", str(tmp_path / "nowhere"), "--out", str(tmp_path / "n")])
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
    result = refine(tmp_path / "frames", case.slam, tmp_path / "run", SETTINGS, masks="carrier")
    found = cv2.imread(str(tmp_path / "run/carrier.png"), cv2.IMREAD_UNCHANGED) == 0
    assert _overlap(found, mask) >= 0.9
    seen = erp_from_bearings(result.reconstruction.observation_bearings, WIDTH, HEIGHT)
    columns, rows = np.minimum(seen.astype(int), [WIDTH - 1, HEIGHT - 1]).T
    assert not found[rows, columns].any()
    assert len(list((tmp_path / "run/colmap/masks").rglob("*.png"))) == 6 * len(walk)
    assert "carrier.png" in json.loads((tmp_path / "run/gsba.json").read_text())["wrote"]
    again = refine(tmp_path / "frames", case.slam, tmp_path / "run", SETTINGS, masks="carrier")
    assert computed_stages(again) == []
