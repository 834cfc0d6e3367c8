"""Undamaged inputs of `fuzz.py`, made once: a walk and its run, tables, images, a video."""

import shutil
from pathlib import Path

import cv2
import numpy as np
from damage import copied

from gsba.config import RefineSettings
from gsba.demo.degrade import degrade
from gsba.demo.gallery import build_gallery
from gsba.demo.render import render_erp
from gsba.demo.walk import walk_poses
from gsba.trajectory.files import write_tum
from gsba.types import Trajectory

NUM, WIDTH = 8, 512  # frames of the walk
SETTINGS = {
    "cubemap": {"min_face_size": 256, "max_face_size": 256},
    "features": {"max_per_face": 400},
    "patches": {"rounds": 0},
    "export": {"formats": []},
    "solver": {"num_threads": 2},
}
WALK = walk_poses("open", "locked", 3 * NUM, 0)
TRUTH = Trajectory(WALK.timestamps[:NUM], WALK.world_T_rigs[:NUM])


def prepare(out: Path) -> None:
    """Make the inputs of all cases once: a walk and its run, tables, images, a video."""
    from gsba import GsbaError, load_run, refine
    from gsba.splat import read_ply
    from gsba.splat.gaussians import from_cloud, write_ply

    try:
        load_run(out / "light")  # of this version
        return
    except GsbaError:
        pass
    shutil.rmtree(out, ignore_errors=True)
    slam = degrade(TRUTH, 0)
    _make_pictures(out)
    _make_tables(out, slam)
    settings = RefineSettings.model_validate(SETTINGS)
    result = refine(out / "frames", out / "slam.tum", out / "run", settings)
    for name in ("gsba.json", "stages/reconstruction.npz", "stages/frames.npz", "trajectory.tum"):
        copied(out / "run" / name, out / "light" / name)
    cloud = result.reconstruction
    write_ply(out / "splat.ply", from_cloud(cloud.points_world[:40], cloud.point_colors[:40], 1))
    load_run(out / "light")
    read_ply(out / "splat.ply")


def _make_pictures(out: Path) -> None:
    """Make the walk, its video, frames without texture or of noise, a mask, true depths."""
    import av
    from PIL import Image

    rng, scene = np.random.default_rng(0), build_gallery()
    for folder in ("frames", "flat", "noisy", "depth"):
        (out / folder).mkdir(parents=True)
    rows = [f"{f:06d}.jpg,{t!r}" for f, t in enumerate(TRUTH.timestamps.tolist())]
    for table in (out / "times.csv", out / "frames/timestamps.csv"):
        table.write_text("\n".join(["name,timestamp", *rows]) + "\n")
    with av.open(str(out / "walk.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=4)
        stream.width, stream.height, stream.pix_fmt = 128, 64, "yuv420p"
        for f, world_T_rig in enumerate(TRUTH.world_T_rigs):
            image = np.clip(render_erp(scene, world_T_rig, WIDTH, WIDTH // 2), 0, 255)
            image = image.astype(np.uint8)
            cv2.imwrite(str(out / f"frames/{f:06d}.jpg"), image[..., ::-1])
            cv2.imwrite(str(out / f"flat/{f:06d}.jpg"), np.full((32, 64, 3), 90, np.uint8))
            np.savez(out / f"depth/{f:06d}.npz", range=rng.uniform(1, 9, (16, 32)))
            for part in np.split(cv2.resize(image, (128, 64))[None].repeat(2, 0), 2):
                container.mux(stream.encode(av.VideoFrame.from_ndarray(part[0], format="rgb24")))
        container.mux(stream.encode())
    cv2.imwrite(str(out / "mask.png"), np.full((32, 64), 255, np.uint8))
    for f, suffix in enumerate(("jpg", "png", "jpg", "jpg")):
        image = Image.fromarray(rng.integers(0, 256, (32, 64, 3), np.uint8))
        exif = Image.Exif()
        exif.get_ifd(0x8825).update(
            {1: "N", 2: (48.0, f / 10, 0.0), 3: "E", 4: (11.0, 0.0, 0.0), 6: 500.0}
        )
        image.save(out / f"noisy/{f}.{suffix}", exif=exif)


def _make_tables(out: Path, slam: Trajectory) -> None:
    """Make poses in every format, and GPS positions."""
    import msgpack

    from gsba.geometry import inverse, quaternion_from_rotation

    write_tum(out / "slam.tum", slam)
    write_tum(out / "truth.tum", TRUTH)
    write_tum(out / "keyframes.tum", Trajectory(slam.timestamps[::2], slam.world_T_rigs[::2]))
    rows = slam.world_T_rigs[:, :3].reshape(NUM, 12)
    np.savetxt(out / "poses.kitti", rows)
    rigs = inverse(slam.world_T_rigs)
    wxyz = quaternion_from_rotation(rigs[:, :3, :3])
    keyframes = {
        str(f): {
            "ts": float(slam.timestamps[f]),
            "rot_cw": wxyz[f, [1, 2, 3, 0]].tolist(),
            "trans_cw": rigs[f, :3, 3].tolist(),
        }
        for f in range(NUM)
    }
    (out / "map.msg").write_bytes(msgpack.packb({"cameras": {}, "keyframes": keyframes}))  # type: ignore[arg-type]
    x, y, z = TRUTH.world_T_rigs[:, :3, 3].T
    places = np.column_stack([48 + z / 111_320, 11 + x / 74_490, 500 - y])
    lines = [
        f"{t!r},{a:.9f},{b:.9f},{c:.3f}"
        for t, (a, b, c) in zip(TRUTH.timestamps.tolist(), places, strict=True)
    ]
    (out / "gps.csv").write_text("\n".join(["timestamp,lat,lon,alt", *lines]) + "\n")
    points = "\n".join(
        f'<trkpt lat="{a:.9f}" lon="{b:.9f}"><ele>{c:.3f}</ele>'
        f"<time>1970-01-01T00:00:{t:09.6f}Z</time></trkpt>"
        for t, (a, b, c) in zip(TRUTH.timestamps, places, strict=True)
    )
    space = 'xmlns="http://www.topografix.com/GPX/1/1"'
    head = '<?xml version="1.0" encoding="UTF-8"?>\n'
    (out / "track.gpx").write_text(f"{head}<gpx {space}><trk><trkseg>{points}</trkseg></trk></gpx>")
