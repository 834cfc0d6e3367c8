"""Calibrations of raw lenses: of our own form, of Kalibr, of COLMAP; and what is refused."""

import json
import re
from dataclasses import astuple, replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
import yaml
from refusals import refused
from scipy.spatial.transform import Rotation
from two_fisheyes import back_from_front, made_pair, turned

from gsba.camera.calibration import calibration_json, read_calibration, scaled_to_size
from gsba.camera.fisheye import Pair, project, rotation_of
from gsba.geometry import pose, quaternion_from_rotation

CENTRE = np.array([0.001, -0.002, 0.016])
SQUARE = 1.003  # of focal lengths across and down to their geometric mean, in files that have both


def _in_middle_axes() -> Pair:
    """Lenses in the rig of other programs' files: their axes mirror each other about the middle,
    and the front one's x has nothing of the rig's y."""
    front, back = made_pair()
    of_front = Rotation.from_euler("YX", [0.03, -0.02]).as_matrix()
    spin = Rotation.from_euler("z", -1.5).as_matrix()
    of_back = np.diag([1.0, 1, -1]) @ of_front @ np.diag([1.0, -1, 1]) @ spin
    x, y, z = CENTRE
    return (
        replace(turned(front, of_front), centre=(x, y, z)),
        replace(turned(back, of_back), centre=(-x, -y, -z)),
    )


PAIR = _in_middle_axes()


def _check_same(found: Pair, expected: Pair, atol: float = 1e-9) -> None:
    for one, other in zip(found, expected, strict=True):
        assert (one.width, one.height) == (other.width, other.height)
        for name in ("focal", "principal", "radial", "centre"):
            values = getattr(one, name), getattr(other, name)
            np.testing.assert_allclose(*values, atol=atol, err_msg=name)
        np.testing.assert_allclose(rotation_of(one), rotation_of(other), atol=atol)


def _write(path: Path, tree: Any) -> Path:
    text = json.dumps(tree)
    if path.suffix in (".yaml", ".yml"):
        text = yaml.safe_dump(json.loads(text))  # without aliases of lists that are one object
    path.write_text(text)
    return path


def _ours() -> dict[str, Any]:
    return calibration_json(PAIR, CENTRE, "m", {"readout_s": 0.01})


def _kalibr() -> dict[str, Any]:
    """A camchain as Kalibr writes it; centres of pixels are whole numbers there."""
    tree: dict[str, Any] = {}
    for number, lens in enumerate(PAIR):
        x, y = lens.principal
        tree[f"cam{number}"] = {
            "cam_overlaps": [1 - number],
            "camera_model": "pinhole",
            "distortion_coeffs": list(lens.radial),
            "distortion_model": "equidistant",
            "intrinsics": [lens.focal * SQUARE, lens.focal / SQUARE, x - 0.5, y - 0.5],
            "resolution": [lens.width, lens.height],
            "rostopic": f"/cam{number}/image_raw",
        }
    tree["cam1"]["T_cn_cnm1"] = back_from_front(PAIR).tolist()
    return tree


def _params(number: int) -> list[float]:
    lens = PAIR[number]
    return [lens.focal * SQUARE, lens.focal / SQUARE, *lens.principal, *lens.radial]


def _rig_config() -> list[dict[str, Any]]:
    back_T_front = back_from_front(PAIR)
    cameras = [
        {
            "image_prefix": f"{name}/",
            "camera_model_name": "OPENCV_FISHEYE",
            "camera_params": _params(number),
            "width": 240,
            "height": 240,
        }
        for number, name in enumerate(("front", "back"))
    ]
    cameras[0]["ref_sensor"] = True
    cameras[1]["cam_from_rig_rotation"] = quaternion_from_rotation(back_T_front[:3, :3]).tolist()
    cameras[1]["cam_from_rig_translation"] = back_T_front[:3, 3].tolist()
    return [{"cameras": cameras}]


def _model(folder: Path, in_text: bool, model: str = "OPENCV_FISHEYE", rig: bool = True) -> Path:
    """A sparse model of cameras alone, the front lens's number above the back one's."""
    made = pycolmap.Reconstruction()
    for number, index in enumerate((7, 3)):
        params = _params(number) if model == "OPENCV_FISHEYE" else [240, 120]
        camera = pycolmap.Camera(camera_id=index, model=model, width=240, height=240, params=params)
        if rig:
            made.add_camera(camera)
        else:
            made.add_camera_with_trivial_rig(camera)
    if rig:
        both = pycolmap.Rig(rig_id=1)
        both.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, 7))
        back_T_front = back_from_front(PAIR)
        at = pycolmap.Rigid3d(pycolmap.Rotation3d(back_T_front[:3, :3]), back_T_front[:3, 3])
        both.add_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, 3), at)
        made.add_rig(both)
    folder.mkdir()
    (made.write_text if in_text else made.write_binary)(folder)
    return folder


def test_our_own_form_is_read_back(tmp_path: Path) -> None:
    _check_same(read_calibration(_write(tmp_path / "c.json", _ours())), PAIR, 1e-14)
    off = _ours()
    for name in ("front", "back"):
        for row in range(3):
            off["lenses"][name]["rig_T_lens"][row][3] += 0.3  # the origin is laid in the middle
    _check_same(read_calibration(_write(tmp_path / "c.json", off)), PAIR, 1e-14)
    in_yaml = read_calibration(_write(tmp_path / "c.yaml", _ours()))
    _check_same(in_yaml, PAIR, 1e-14)


def test_our_own_form_keeps_the_axes_of_its_rig(tmp_path: Path) -> None:
    pair = made_pair()
    tree = calibration_json(pair, np.array(pair[0].centre), "m", {})
    _check_same(read_calibration(_write(tmp_path / "c.json", tree)), pair, 1e-14)


def test_lengths_of_a_map_are_not_metres(tmp_path: Path) -> None:
    tree = calibration_json(PAIR, CENTRE, "map", {})
    found = read_calibration(_write(tmp_path / "c.json", tree))
    _check_same(found, (replace(PAIR[0], centre=(0, 0, 0)), replace(PAIR[1], centre=(0, 0, 0))))


@pytest.mark.parametrize(
    ("unit", "metres"), [("cm", 0.01), ("mm", 0.001), ("in", 0.0254), ("ft", 0.3048)]
)
def test_lengths_of_known_units_become_metres(tmp_path: Path, unit: str, metres: float) -> None:
    tree = calibration_json(PAIR, CENTRE / metres, unit, {})
    _check_same(read_calibration(_write(tmp_path / "lenses.json", tree)), PAIR)
    tree = _rig_config()
    tree[0]["unit"] = unit
    for camera in tree[0]["cameras"]:
        if "cam_from_rig_translation" in camera:
            camera["cam_from_rig_translation"] = [
                x / metres for x in camera["cam_from_rig_translation"]
            ]
    _check_same(read_calibration(_write(tmp_path / "rig_config.json", tree)), PAIR)


@pytest.mark.parametrize("unit", ["furlong", "M", "", None, 3, ["m"], {"m": 1}, "x" * 100_000])
def test_lengths_of_unknown_units_are_refused(tmp_path: Path, unit: Any) -> None:
    rig = _rig_config()
    rig[0]["unit"] = unit
    for tree in (_ours() | {"unit": unit}, rig):
        line = refused(
            r"unit .* is not known: use m, cm, mm, in",
            read_calibration,
            _write(tmp_path / "lenses.json", tree),
        )
        assert len(line) < 600


def test_aliases_of_yaml_are_refused(tmp_path: Path) -> None:
    """Nine lines of them can stand for a list of a billion: the first one is refused."""
    path = tmp_path / "cam.yaml"
    path.write_text("a0: &a0 [x]\ncam0: *a0\n")
    refused(r"line 2 holds an alias; write out what it stands for", read_calibration, path)


def test_files_that_are_too_large_for_a_calibration_are_not_parsed(tmp_path: Path) -> None:
    path = tmp_path / "cam.yaml"
    path.write_text(yaml.safe_dump(_kalibr()) + "#" * (1 << 18))
    refused(r"is larger than any calibration, 256 kB", read_calibration, path)
    refused(r"is larger than any calibration", read_calibration, Path("/dev/zero"))


def test_one_size_and_two_terms_are_enough(tmp_path: Path) -> None:
    tree = _ours()
    for lens in tree["lenses"].values():
        del lens["width"], lens["height"]
        lens["size"], lens["k"] = 240, lens["k"][:2]
    front, back = read_calibration(_write(tmp_path / "c.json", tree))
    assert (front.width, back.height) == (240, 240)
    assert front.radial == (*PAIR[0].radial[:2], 0, 0)


@pytest.mark.parametrize("name", ["camchain.yaml", "camchain.YML", "camchain.txt"])
def test_kalibr(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_text(yaml.safe_dump(_kalibr()))
    _check_same(read_calibration(path), PAIR)


def test_colmap_rig_config(tmp_path: Path) -> None:
    tree = _rig_config()
    _check_same(read_calibration(_write(tmp_path / "rig_config.json", tree)), PAIR)
    tree[0]["cameras"].reverse()  # the front one is named, whatever comes first
    _check_same(read_calibration(_write(tmp_path / "rig_config.json", tree)), PAIR)
    _check_same(read_calibration(_write(tmp_path / "rig.json", tree[0])), PAIR)
    tree[0]["unit"] = "map"
    found = read_calibration(_write(tmp_path / "rig_config.json", tree))
    _check_same(found, (replace(PAIR[0], centre=(0, 0, 0)), replace(PAIR[1], centre=(0, 0, 0))))


@pytest.mark.parametrize("in_text", [False, True])
def test_colmap_model(tmp_path: Path, in_text: bool) -> None:
    found = read_calibration(_model(tmp_path / "sparse", in_text))
    _check_same(found, (replace(PAIR[0], centre=(0, 0, 0)), replace(PAIR[1], centre=(0, 0, 0))))


def _omni(tree: dict[str, Any], distortion: list[float], xi: float = 1.7) -> dict[str, Any]:
    """The same cameras, omni with radtan."""
    for number in (0, 1):
        camera = tree[f"cam{number}"]
        camera |= {"camera_model": "omni", "distortion_model": "radtan"}
        camera["distortion_coeffs"] = distortion
        camera["intrinsics"] = [xi, 190.0, 190.0, 119.0, 121.0]
    return tree


def test_kalibr_omni_is_taken_where_it_is_nearly_ours(tmp_path: Path) -> None:
    distortion = [-0.05, 0.02, 0.0002, -0.0001]
    front, _ = read_calibration(_write(tmp_path / "c.yaml", _omni(_kalibr(), distortion)))
    angles, around = np.meshgrid(np.deg2rad(np.linspace(0, 95, 40)), np.linspace(0, 6, 13))
    away = np.stack([np.cos(around), np.sin(around)], axis=-1)
    local = np.concatenate([np.sin(angles)[..., None] * away, np.cos(angles)[..., None]], axis=-1)
    x, y = np.moveaxis(local[..., :2] / (local[..., 2:] + 1.7), -1, 0)  # Mei and Rives, ICRA 2007
    k1, k2, p1, p2 = distortion
    r2 = x * x + y * y
    bent = 1 + k1 * r2 + k2 * r2 * r2
    across = x * bent + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    down = y * bent + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    expected = 190 * np.stack([across, down], axis=-1) + [119.5, 121.5]
    found = project(front, local @ rotation_of(front).T)
    assert np.linalg.norm(found - expected, axis=-1).max() < 0.1


@pytest.mark.parametrize("distortion", [[0.0, 0, 0.01, 0], [0.0, 60.0, 0, 0]])
def test_kalibr_omni_is_refused_where_it_is_not(tmp_path: Path, distortion: list[float]) -> None:
    path = _write(tmp_path / "c.yaml", _omni(_kalibr(), distortion))
    refused(r"cam0 is omni with radtan, [\d.]+ pixels from the.*-equi$", read_calibration, path)
    path = _write(tmp_path / "c.yaml", _omni(_kalibr(), [0.0, 0, 0, 0], 0.05))
    refused(r"cam0: its omni model ends before 95 degrees", read_calibration, path)


BAD_OURS = {
    "no lens": (lambda t: t["lenses"].pop("back"), "lenses has no back"),
    "no focal length": (lambda t: t["lenses"]["back"].pop("f"), r"lenses\.back has no f"),
    "of text": (
        lambda t: t["lenses"]["back"].update(f="wide"),
        r"lenses\.back: f is 'wide', not a number",
    ),
    "no number": (lambda t: t["lenses"]["back"].update(f=float("nan")), "f is nan, not a number"),
    "endless": (lambda t: t["lenses"]["back"].update(width=1e999), "width is inf, not a number"),
    "negative": (lambda t: t["lenses"]["front"].update(f=-3), "f above 0"),
    "too many terms": (lambda t: t["lenses"]["front"].update(k=[0] * 5), "up to four k"),
    "turns over": (lambda t: t["lenses"]["front"].update(k=[-0.3]), "does not grow"),
    "beside": (
        lambda t: t["lenses"]["back"].update(cx=360.0),
        r"principal point \(360, .*\) is outside the picture of 240x240",
    ),
    "no pose": (
        lambda t: t["lenses"]["front"].update(rig_T_lens=[1, 2]),
        r"is \[1, 2\], not 16 numbers",
    ),
    "bent pose": (
        lambda t: t["lenses"]["front"].update(rig_T_lens=np.full((4, 4), 0.5).tolist()),
        "no rigid motion",
    ),
    "huge pose": (
        lambda t: t["lenses"]["front"].update(rig_T_lens=np.full((4, 4), 1e300).tolist()),
        "no rigid motion",
    ),
    "mirror": (
        lambda t: t["lenses"]["front"].update(rig_T_lens=np.diag([-1.0, 1, 1, 1]).tolist()),
        "mirrors",
    ),
    "both ahead": (
        lambda t: t["lenses"]["back"].update(rig_T_lens=np.eye(4).tolist()),
        "the front lens must look along z of the rig and the back one the other way",
    ),
    "something else": (lambda t: t.pop("lenses"), "it has no lenses.*Kalibr camchain"),
    "no width": (lambda t: t["lenses"]["front"].pop("width"), r"lenses\.front has no width"),
    "a number": (lambda t: t["lenses"].update(back=5), r"lenses\.back is 5, not a group of fields"),
    "a list": (lambda t: t.update(lenses=[1]), r"lenses is \[1\], not a group of fields"),
}


def _check_refused(path: Path, message: str) -> None:
    with np.errstate(over="raise"):
        assert refused(message, read_calibration, path).startswith(str(path))


BAD_KALIBR = {
    "one camera": (lambda t: t.pop("cam1"), "holds cam0; of a raw pair"),
    "three cameras": (lambda t: t.update(cam2=t["cam0"]), "holds cam0, cam1, cam2"),
    "radtan": (
        lambda t: t["cam0"].update(distortion_model="radtan"),
        "cam0 is pinhole with radtan; it must be pinhole with equidistant",
    ),
    "double sphere": (lambda t: t["cam1"].update(camera_model="ds"), "cam1 is ds with equi"),
    "not square": (
        lambda t: t["cam1"].update(intrinsics=[70, 66, 120, 120]),
        "cam1 has focal lengths 70 and 66, more than 1 % apart",
    ),
    "no focal length": (lambda t: t["cam1"].update(intrinsics=[0, 66, 120, 120]), "above 0"),
    "few intrinsics": (lambda t: t["cam1"].update(intrinsics=[70, 120, 120]), "4 intrinsics"),
    "few terms": (lambda t: t["cam0"].update(distortion_coeffs=[0, 0]), "4 distortion_coeffs"),
    "no motion": (lambda t: t["cam1"].pop("T_cn_cnm1"), "cam1 has no T_cn_cnm1"),
    "no camera": (lambda t: t.update(cam1=None), "cam1 is None, not a group of fields"),
    "no resolution": (lambda t: t["cam0"].pop("resolution"), "cam0 has no resolution"),
    "text": (lambda t: t["cam0"].update(intrinsics="a"), "cam0: intrinsics is 'a', not numbers"),
    "scaled": (lambda t: t["cam1"].update(T_cn_cnm1=(2 * np.eye(4)).tolist()), "no rigid motion"),
    "side by side": (
        lambda t: t["cam1"].update(T_cn_cnm1=np.eye(4).tolist()),
        "look less than 90 degrees apart",
    ),
    "across": (
        lambda t: t["cam1"].update(
            T_cn_cnm1=pose(Rotation.from_euler("y", 130, degrees=True).as_matrix(), CENTRE).tolist()
        ),
        "within 20 degrees",
    ),
}


BAD_RIG = {
    "two rigs": (lambda t: t.append(t[0]), "holds 4 cameras in 2 rigs, 2 of them a ref_sensor"),
    "one camera": (lambda t: t[0]["cameras"].pop(), "holds 1 cameras in 1 rigs"),
    "no front": (lambda t: t[0]["cameras"][0].pop("ref_sensor"), "0 of them a ref_sensor"),
    "no size": (
        lambda t: t[0]["cameras"][1].pop("width"),
        "no picture size for the back lens: write width and height, pixels, beside",
    ),
    "pinhole": (
        lambda t: t[0]["cameras"][0].update(camera_model_name="PINHOLE"),
        "front lens is PINHOLE, but must be OPENCV_FISHEYE",
    ),
    "no model": (
        lambda t: t[0]["cameras"][0].pop("camera_model_name"),
        "front lens has no camera_mo",
    ),
    "few params": (lambda t: t[0]["cameras"][0]["camera_params"].pop(), "k1, k2, k3, k4"),
    "not square": (
        lambda t: t[0]["cameras"][0].update(camera_params=[60, 70, 120, 120, 0, 0, 0, 0]),
        "front lens has focal lengths 60 and 70",
    ),
    "no turn": (
        lambda t: t[0]["cameras"][1].pop("cam_from_rig_rotation"),
        "back lens has no cam_from",
    ),
    "no quaternion": (
        lambda t: t[0]["cameras"][1].update(cam_from_rig_rotation=[0, 0, 0, 0]),
        "quaternion wxyz",
    ),
    "no rigs": (lambda t: t.clear(), "holds 0 cameras in 0 rigs"),
    "a number": (lambda t: t.__setitem__(0, 3), "a rig is 3, not a group of fields"),
    "no list": (lambda t: t[0].update(cameras=3), "cameras of a rig is 3, not a list"),
}


FORMS = {"ours": (_ours, BAD_OURS), "kalibr": (_kalibr, BAD_KALIBR), "rig": (_rig_config, BAD_RIG)}


@pytest.mark.parametrize(("form", "case"), [(f, case) for f in FORMS for case in FORMS[f][1]])
def test_refused_of_each_form(tmp_path: Path, form: str, case: str) -> None:
    make, cases = FORMS[form]
    change, message = cases[case]
    tree = make()
    change(tree)
    _check_refused(_write(tmp_path / ("c.yaml" if form == "kalibr" else "c.json"), tree), message)


def test_refused_models(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    _check_refused(tmp_path / "empty", "is no COLMAP model that can be read .*give the folder")
    _check_refused(_model(tmp_path / "alone", True, rig=False), "holds 2 cameras in 2 rigs")
    panoramas = _model(tmp_path / "erp", True, "EQUIRECTANGULAR")
    _check_refused(panoramas, "front lens is EQUIRECTANGULAR, but must be OPENCV_FISHEYE")
    damaged = _model(tmp_path / "damaged", False)
    (damaged / "cameras.bin").write_bytes((damaged / "cameras.bin").read_bytes()[:50])
    _check_refused(damaged, "is no COLMAP model that can be read")


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("c.json", b"{", "is neither JSON nor YAML"),
        ("c.json", b"", "is neither JSON nor YAML"),
        ("c.json", b"[" * 100_000, "is neither JSON nor YAML"),
        ("c.json", b"3", "it is 3, not a group of fields"),
        ("c.json", b"null", "it is None, not a group"),
        ("c.json", b'"cameras"', "it is 'cameras', not a group"),
        ("c.json", b'{"lenses": []}', r"lenses is \[\], not a group"),
        ("c.json", bytes(range(256)), "is no text"),
        ("c.yaml", b"cam0: [1, 2\ncam1: }", "is neither JSON nor YAML"),
        ("c.yaml", b"", "it is None, not a group"),
        ("c.txt", b"cam0:\n\t- 3", "is neither JSON nor YAML"),
    ],
)
def test_refused_files(tmp_path: Path, name: str, content: bytes, message: str) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    _check_refused(path, message)


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    _check_refused(tmp_path / "none.json", "cannot be read")


def test_pictures_of_another_size(tmp_path: Path) -> None:
    path = tmp_path / "c.json"
    twice = scaled_to_size(PAIR, (480, 480), path)
    for lens, large in zip(PAIR, twice, strict=True):
        directions = np.random.default_rng(0).normal(size=(20, 3))
        found = project(large, directions)
        np.testing.assert_allclose(found, 2 * project(lens, directions), atol=1e-9)
        assert (large.width, large.height, large.centre) == (480, 480, lens.centre)
    same = scaled_to_size(PAIR, (240, 240), path)
    assert [astuple(lens) for lens in same] == [*map(astuple, PAIR)]
    message = (
        f"{re.escape(str(path))}: calibrates pictures of 240x240, but these are 480x360: another"
    )
    refused(message, scaled_to_size, PAIR, (480, 360), path)
