#!/usr/bin/env bash
# Blender 4.5.15 (bpy), importing glTF in a scene of 29.97 frames per second (fps 30, fps_base
# 1.001): seconds are multiplied by fps * fps_base, while Blender plays fps / fps_base frames a second.
# Expected of a key at 1000 s: frame 29970.03, as the scene shows that frame 1000 s after frame 0.
# Seen: frame 30030, two seconds late.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3.11 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet bpy==4.5.15
cd "$work"
"$work/venv/bin/python" - <<'PROGRAM'
import base64, json, struct
import bpy

content = struct.pack("<2f", 0, 1000) + struct.pack("<6f", 0, 0, 0, 1, 0, 0)
uri = "data:application/octet-stream;base64," + base64.b64encode(content).decode()
document = {
    "asset": {"version": "2.0"},
    "scene": 0,
    "scenes": [{"nodes": [0]}],
    "nodes": [{"name": "moving"}],
    "buffers": [{"byteLength": len(content), "uri": uri}],
    "bufferViews": [{"buffer": 0, "byteLength": 8}, {"buffer": 0, "byteOffset": 8, "byteLength": 24}],
    "accessors": [
        {"bufferView": 0, "componentType": 5126, "count": 2, "type": "SCALAR", "min": [0], "max": [1000]},
        {"bufferView": 1, "componentType": 5126, "count": 2, "type": "VEC3"},
    ],
    "animations": [
        {
            "samplers": [{"input": 0, "output": 1}],
            "channels": [{"sampler": 0, "target": {"node": 0, "path": "translation"}}],
        }
    ],
}
open("scene.gltf", "w").write(json.dumps(document))
render = bpy.context.scene.render
render.fps, render.fps_base = 30, 1.001
bpy.ops.import_scene.gltf(filepath="scene.gltf")
last = bpy.data.objects["moving"].animation_data.action.frame_range[1]
seconds = last * render.fps_base / render.fps
print(f"a key at 1000 s is at frame {last:.2f}, which is shown after {seconds:.2f} s")
assert abs(seconds - 1002) < 0.05, seconds
PROGRAM
