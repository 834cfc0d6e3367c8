"""The glTF scene and its script, by their files and in Blender itself, if there is one."""

import importlib.util
import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from export_scene import HEIGHT, POINTS, WIDTH, bearings, panoramas, poses, reconstruction

from gsba.camera.sphere import erp_from_bearings
from gsba.export import ExportFormat, export

_FRAMES = 0, 3  # of the run, that Blender renders
_REACH = 6  # pixels around a point's place
_MAX_SLOPE = 0.6  # of a bearing's y: nearer to a pole, a sphere's picture has another middle
# Renders the points as glowing spheres at the times of _FRAMES; told of the scene by a JSON line.
_RENDER = """
import json, math, runpy, sys
import bpy
folder, out, frames = sys.argv[1], sys.argv[2], json.loads(sys.argv[3])
runpy.run_path(folder + "/open_in_blender.py", run_name="__main__")
scene, cloud = bpy.context.scene, bpy.data.objects["cloud"]
glow = bpy.data.materials.new("glow")
glow.use_nodes = True
tree = glow.node_tree
tree.nodes.clear()
light, end = (tree.nodes.new("ShaderNode" + kind) for kind in ("Emission", "OutputMaterial"))
tree.links.new(light.outputs[0], end.inputs[0])
for vertex in cloud.data.vertices:
    at = cloud.matrix_world @ vertex.co
    bpy.ops.mesh.primitive_uv_sphere_add(radius=0.1, location=at)
    bpy.context.object.data.materials.append(glow)
scene.cycles.samples, scene.cycles.use_denoising = 16, False
walk = bpy.data.objects["walk"]
apart = []
for marker in scene.timeline_markers:
    scene.frame_set(marker.frame)
    apart.append((walk.matrix_world.translation - scene.camera.matrix_world.translation).length)
    if len(apart) - 1 in frames:
        scene.render.filepath = f"{out}/{len(apart) - 1}.png"
        bpy.ops.render.render(write_still=True)
pictures = [m.camera.data.background_images[0].image.size[:] for m in scene.timeline_markers]
told = {"fps": scene.render.fps, "end": scene.frame_end, "pictures": pictures, "apart": apart}
print("told" + json.dumps(told))
"""


def _document(path: Path) -> dict:
    content = path.read_bytes()
    return json.loads(content[20 : 20 + int.from_bytes(content[12:16], "little")])


def test_the_scene_tells_blender_its_timeline_and_pictures(tmp_path: Path) -> None:
    frames = panoramas(tmp_path / "frames")
    times = np.array([0, 0.02, 0.04, 0.5, 1, 2, 3, 4, 5.0])
    for images in ("auto", "panorama"):
        out = tmp_path / images
        timed = replace(frames, timestamps=times)
        export(reconstruction(), timed, out, ExportFormat.GLTF, images=images)
        document = _document(out / "scene.glb")
        compile((out / "open_in_blender.py").read_text(), "open_in_blender.py", "exec")
        about, nodes = document["scenes"][0]["extras"], document["nodes"][1:-1]
        assert about["fps"] == 50  # each picture has a frame of its own
        assert [node["extras"]["frame"] for node in nodes] == [0, 1, 2, 25, 50, 100, 150, 200, 250]
        lens = document["cameras"][0]["perspective"]
        across = np.tan(lens["yfov"] / 2) * lens["aspectRatio"]
        assert across == pytest.approx(1) and lens["aspectRatio"] == pytest.approx(1920 / 1080)
        seen = np.linalg.norm(POINTS - poses()[:, None, :3, 3], axis=2)
        assert lens["znear"] < 1e-3 * seen.min() and seen.max() < lens["zfar"] < 1e3 * seen.max()
        if images == "auto":
            assert "width" not in about and not (out / "images").exists()
            continue
        assert (about["width"], about["height"]) == (WIDTH, HEIGHT)
        for node, (source,) in zip(nodes, frames.paths, strict=True):
            assert (out / node["extras"]["picture"]).read_bytes() == source.read_bytes()


def test_a_day_fits_blenders_timeline(tmp_path: Path) -> None:
    frames = panoramas(tmp_path / "frames")
    frames = replace(frames, timestamps=np.linspace(0, 86400, len(frames)))
    export(reconstruction(), frames, str(tmp_path / "out"), ExportFormat.GLTF)
    document = _document(tmp_path / "out/scene.glb")
    assert document["scenes"][0]["extras"]["fps"] == 11
    assert document["nodes"][-2]["extras"]["frame"] == 11 * 86400


@pytest.mark.consumers
def test_blender_shows_points_where_the_pictures_do(tmp_path: Path) -> None:
    """Panoramic cameras render each point within a fifth of a pixel of its place."""
    python = os.environ.get("BLENDER_PYTHON")
    if python is None and importlib.util.find_spec("bpy") is None:
        pytest.skip("no bpy: name a Python that has it in BLENDER_PYTHON")
    frames = panoramas(tmp_path / "frames")
    export(reconstruction(), frames, tmp_path / "out", ExportFormat.GLTF, images="panorama")
    command = [python or sys.executable, "-c", _RENDER, tmp_path / "out", tmp_path, str([*_FRAMES])]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert ran.returncode == 0, ran.stderr
    (line,) = [line for line in ran.stdout.splitlines() if line.startswith("told")]
    told = json.loads(line.removeprefix("told"))
    assert told["fps"] == 24 and told["end"] == 96  # half a second apart
    assert told["pictures"] == [[WIDTH, HEIGHT]] * len(frames)
    assert max(told["apart"]) < 1e-5  # the walk passes each camera at its time
    looked = 0
    for f in _FRAMES:
        image = cv2.imread(str(tmp_path / f"{f}.png"), cv2.IMREAD_GRAYSCALE)
        assert image is not None and image.shape == (HEIGHT, WIDTH)
        seen = bearings(poses())[f]
        level = np.abs(seen[:, 1]) < _MAX_SLOPE
        for pixel in erp_from_bearings(seen[level], WIDTH, HEIGHT):
            looked += _assert_centred(image, pixel)
    assert looked > 8


def _assert_centred(image: np.ndarray, pixel: np.ndarray) -> bool:
    """Check that light is centred within 0.2 px of `pixel`; False = it is cut by the border."""
    column, row = np.floor(pixel).astype(int)
    if not _REACH <= column < WIDTH - _REACH:
        return False
    window = image[row - _REACH : row + _REACH + 1, column - _REACH : column + _REACH + 1]
    rows, columns = np.mgrid[-_REACH : _REACH + 1, -_REACH : _REACH + 1] + 0.5
    assert window.max() > 100
    centre = np.array([(window * columns).sum(), (window * rows).sum()]) / window.sum()
    assert np.linalg.norm(centre + np.array([column, row]) - pixel) < 0.2
    return True
