"""Opens scene.glb, in this file's folder, as a new scene of Blender 4.2 or later.

    blender --python open_in_blender.py

glTF has no frame range, no active camera and no panoramic cameras, so that this sets them: the
scene begins at frame 0, ends with the walk, and changes to each frame's camera at its time. Where
pictures were exported, cameras are panoramic (Cycles) and have their picture as background.
"""

import json
from pathlib import Path

import bpy  # pyright: ignore[reportMissingImports]

FOLDER = Path(__file__).resolve().parent


def main() -> None:
    """Make the scene, and make it the one that is shown."""
    content = (FOLDER / "scene.glb").read_bytes()
    length = int.from_bytes(content[12:16], "little")  # of the JSON chunk
    about = json.loads(content[20 : 20 + length])["scenes"][0]["extras"]
    scene = bpy.data.scenes.new("gsba")
    bpy.context.window.scene = scene
    scene.render.fps = about["fps"]  # before the import, which turns seconds into frames
    known = set(bpy.data.objects)
    bpy.ops.import_scene.gltf(filepath=str(FOLDER / "scene.glb"))
    cameras = [new for new in bpy.data.objects if new not in known and new.type == "CAMERA"]
    taken = sorted((new for new in cameras if "frame" in new), key=lambda new: new["frame"])
    scene.frame_start, scene.frame_end = 0, taken[-1]["frame"]
    for camera in taken:
        marker = scene.timeline_markers.new(camera.name, frame=camera["frame"])
        marker.camera = camera  # bound: the scene's camera from this frame on
    scene.frame_set(0)
    scene.camera = taken[0]
    if "width" in about:
        scene.render.engine = "CYCLES"
        scene.render.resolution_x, scene.render.resolution_y = about["width"], about["height"]
        for camera in cameras:
            make_panoramic(camera.data)
        for camera in taken:
            show_picture(camera.data, FOLDER / camera["picture"])


def make_panoramic(camera: bpy.types.Camera) -> None:
    """Turn a camera into an equirectangular one, which looks along the middle of its picture."""
    camera.type = "PANO"
    kind = camera if hasattr(camera, "panorama_type") else camera.cycles  # Blender 5, 4
    kind.panorama_type = "EQUIRECTANGULAR"


def show_picture(camera: bpy.types.Camera, path: Path) -> None:
    """Show a picture behind what is seen through a camera."""
    background = camera.background_images.new()
    background.image = bpy.data.images.load(str(path), check_existing=True)
    background.alpha = 1.0
    camera.show_background_images = True


if __name__ == "__main__":
    main()
