"""Masks of exports, where each program looks for them and by what it takes from them."""

import json
from pathlib import Path

import numpy as np
import pytest
from export_scene import panoramas, reconstruction
from PIL import Image

from gsba.export import ExportOptions, export_all
from gsba.export.trainers import PROGRAMS, format_of, how_to_start, options_for
from gsba.log import GsbaError
from gsba.types import FrameSet

ROWS = np.arange(2)


def _exported(name: str, out: Path, frames: FrameSet, paint: str = "files", **more) -> Path:
    options = options_for(name, ExportOptions(face_size=32, split=False, **more), paint)
    export_all(reconstruction().taken(ROWS), frames, {format_of(name): out}, options)
    return out


def _pixels(path: Path) -> np.ndarray:
    return np.array(Image.open(path)).astype(int)


def test_3dgrut_and_instant_ngp_find_masks_beside_images(tmp_path: Path) -> None:
    frames = panoramas(tmp_path / "frames", masked=True).taken(ROWS)
    masks = (_exported("gsplat", tmp_path / "plain", frames) / "masks").glob("*.png")
    plain = {path.stem: _pixels(path) for path in masks}
    assert len(plain) == 12 and {0, 255} == set(np.unique(list(plain.values())))
    grut = _exported("3dgrut", tmp_path / "grut", frames)
    ngp = _exported("instant-ngp", tmp_path / "ngp", frames)
    for stem, mask in plain.items():  # 3dgrut uses what is above a half, instant-ngp what is 0
        np.testing.assert_array_equal(_pixels(grut / f"images/{stem}_mask.png"), mask)
        np.testing.assert_array_equal(_pixels(ngp / f"images/dynamic_mask_{stem}.png"), 255 - mask)
        assert (grut / f"images/{stem}.png").is_file() and (ngp / f"images/{stem}.png").is_file()
    meta = json.loads((ngp / "transforms.json").read_text())
    assert not any("mask_path" in entry for entry in meta["frames"])  # others read them upside down
    assert not (grut / "masks").exists() and not (ngp / "masks").exists()
    loaded = [path.name for path in ngp.glob("*.json") if "frames" in json.loads(path.read_text())]
    assert loaded == ["transforms.json"]


@pytest.mark.parametrize("name", ["opensplat", "nerfstudio", "metashape", "colmap"])
def test_faces_are_painted_where_masks_hide(name: str, tmp_path: Path) -> None:
    frames, more = panoramas(tmp_path / "frames", masked=True).taken(ROWS), {"images": "cube"}
    plain = _exported(name, tmp_path / "plain", frames, **more)
    black = _exported(name, tmp_path / "black", frames, "black", **more)
    alpha = _exported(name, tmp_path / "alpha", frames, "alpha", **more)
    images = sorted(path.relative_to(plain / "images") for path in plain.glob("images/**/*.png"))
    assert len(images) == 12
    hidden = 0
    for image in images:
        path = f"{image}.png" if name == "colmap" else str(image)
        used = _pixels(plain / "masks" / path) == 255
        shown = _pixels(plain / "images" / image)
        np.testing.assert_array_equal(_pixels(plain / "masks" / path), 255 * used)
        np.testing.assert_array_equal(_pixels(black / "images" / image), shown * used[..., None])
        painted = _pixels(alpha / "images" / image)
        np.testing.assert_array_equal(painted[..., :3], shown * used[..., None])
        np.testing.assert_array_equal(painted[..., 3], 255 * used)
        hidden += np.count_nonzero(~used)
    assert hidden > 1000


def test_images_of_jpegs_get_an_alpha_channel_as_png(tmp_path: Path) -> None:
    frames = panoramas(tmp_path / "frames", ".jpg", masked=True).taken(ROWS)
    out = _exported("inria", tmp_path / "alpha", frames, "alpha")
    assert {path.suffix for path in (out / "images").iterdir()} == {".png"}
    frames = panoramas(tmp_path / "frames", ".jpg").taken(ROWS)  # nothing is hidden
    out = _exported("inria", tmp_path / "without", frames, "alpha")
    assert {path.suffix for path in (out / "images").iterdir()} == {".jpg"}


def test_programs_that_read_no_masks_are_named(tmp_path: Path) -> None:
    (tmp_path / "masks").mkdir()
    silent = [name for name in PROGRAMS if len(how_to_start(name, tmp_path)) == 1]
    assert sorted(set(PROGRAMS) - set(silent)) == ["gsplat", "inria", "opensplat"]
    assert how_to_start("gsplat", tmp_path)[1].startswith("gsplat reads no masks")
    assert len(how_to_start("gsplat", tmp_path, "alpha")) == 1


def test_images_that_a_program_cannot_read_are_refused(tmp_path: Path) -> None:
    with pytest.raises(GsbaError, match="--masks white is not known: use one of files, alpha, bl"):
        options_for("colmap", ExportOptions(), "white")
    with pytest.raises(GsbaError, match="--masks alpha: 3dgrut reads no images with an alpha"):
        options_for("3dgrut", ExportOptions(), "alpha")
    frames = panoramas(tmp_path / "frames")
    with pytest.raises(GsbaError, match=r"reads cameras PINHOLE alone: use --images lenses"):
        _exported("inria", tmp_path / "out", frames, images="fisheye")
    assert not list(tmp_path.glob("*out*"))


def test_painting_without_masks_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    frames = panoramas(tmp_path / "frames").taken(ROWS)
    _exported("opensplat", tmp_path / "out", frames, "black")
    assert "no frame has a mask: images are not painted" in caplog.text
