"""Arguments and options of all commands: their help, and the names of their values."""

from typing import Any

import typer


def _argument(help_text: str, metavar: str | None = None) -> Any:
    return typer.Argument(help=help_text, metavar=metavar)


def _option(help_text: str, metavar: str | None = None, *names: str, **checks: Any) -> Any:
    """Option of `names`; none: --NAME of its parameter."""
    return typer.Option(*names, help=help_text, metavar=metavar, **checks)


def _list_families(value: str | None) -> str | None:
    """`--factors list`: the installed families, and nothing else is done."""
    if value == "list":
        from gsba.config import BUILT_IN, installed_families

        packages = {name: f"of {point.value}" for name, point in installed_families().items()}
        shown = {**BUILT_IN, **packages}
        width = max(map(len, shown)) + 2
        typer.echo("\n".join(f"{name:<{width}}{summary}" for name, summary in shown.items()))
        raise typer.Exit
    return value


_RESULT = _option(
    "Folder of the result, which leaves RUN as it is; default: RUN, and what was there is kept "
    "as RUN-before.",
    "DIR",
)

OPTIONS = {  # PARAMETER, or COMMAND.PARAMETER where commands differ -> its help
    # of several commands
    "out": _option("Folder of the run; default: named after the video, or FRAMES-run.", "RUN"),
    "recording": _option(
        "One of several recordings, with what belongs to it: name, trajectory, keyframes, masks, "
        "timestamps, fps, calibration, circles, imu, camera, odometry. Repeatable.",
        "PATH,KEY=VALUE,...",
    ),
    "no_trajectory": _option("Start from pairs of images, for a video without odometry, too."),
    "config": _option(
        "TOML file of settings, or a preset: fast, accurate, bearing, photometric, reprojection.",
        "FILE|PRESET",
    ),
    "overrides": _option("Override a setting; repeatable.", "STAGE.KEY=VALUE", "--set"),
    "masks": _option(
        "One mask for all frames, or a folder of masks; white = use. auto (default): mask the "
        "carrier of the camera where it is found; carrier: fail where frames do not tell it; "
        "distractors: mask moving objects; none. Repeatable.",
        "PATH",
    ),
    "segment": _option(
        "Command that makes masks of cube faces: called with two folders, IMAGES MASKS.", "COMMAND"
    ),
    "factors": _option(
        "Families of residuals, separated by commas: bearing, reprojection, gps, photometric, "
        "splat, and those of packages, as NAME or NAME:ARGUMENT; list: shows all that there are.",
        callback=_list_families,
    ),
    "camera": _option(
        "Camera model, e.g. insta360-x5: sets priors for lens distance and readout time.", "NAME"
    ),
    "calibration": _option("Calibration of the lenses of raw fisheyes.", "FILE"),
    "fps": _option(
        "Frame rate of a folder, from time 0. Of a video: frames to keep per second; default: "
        "odometry chooses them, or, where a trajectory is given, 1."
    ),
    "cluster": _option(
        "Dask scheduler whose workers share the work of frames and pairs: tcp://HOST:PORT, its "
        "FILE.json, local:N, slurm:N, ...",
        "ADDRESS",
    ),
    "allow_partial": _option(
        "Exit with 0 even if less than nine tenths of the frames are in one map, or the verdict on "
        "it is not to train."
    ),
    "fresh": _option("Replace an earlier run."),
    "run": _argument("Folder of a finished run.", "RUN"),
    "iterations": _option("Training steps of one view each."),
    "face_size": _option("Width of a cube face in pixels."),
    "max_gaussians": _option("Most Gaussians; default: set by pixels and memory.", "N"),
    "backend": _option("Renderer: auto, gsplat (CUDA) or cpu."),
    "lpips": _option("Weights of LPIPS; repeatable.", "FILE"),
    "truth": _option("True trajectory (TUM)."),
    "port": _option("Port of 127.0.0.1; 0: any free one."),
    # refine
    "refine.frames": _argument(
        "Folder of 2:1 panoramas, raw fisheyes, .360 tracks or cube faces, or a video."
    ),
    "trajectory": _argument(
        "TUM, KITTI, stella_vslam map.msg or Metashape cameras.xml; several files are pieces of "
        "one trajectory. Default: odometry on a video; pairs of images of stills. A further folder "
        "or video is another recording of the place, and files after it are its trajectory."
    ),
    "refine.keyframes": _option("Keyframe trajectory of the same SLAM run.", "FILE"),
    "trajectory_format": _option(
        "Convention of the trajectory, where it is not x right, y down, z forward with quaternions "
        "x, y, z, w: wxyz, camera-from-world, ways of the camera's x, y and z as forward-left-up; "
        "several with commas between.",
        "WORDS",
    ),
    "refine.timestamps": _option("File with the times of the frames.", "FILE"),
    "circle": _option(
        "Image circle of raw fisheyes where none is found: centre and radius in pixels of one "
        "lens's image. Repeatable: front, then back; one value is for both.",
        "X,Y,R",
    ),
    "imu": _option(
        "Recording of a gyro and an accelerometer on the camera: t [s], gyro x y z [rad/s], "
        "accelerometer x y z [m/s^2]; or a camera maker's file.",
        "FILE",
    ),
    "refine.gps": _option(
        "GPS positions that limit drift, as factors: CSV, GPX, a video, or exif (of the frames).",
        "FILE",
    ),
    "weights": _option(
        "Weights of a learned extractor or matcher: a file, or a folder that holds them under "
        "their official names; repeatable.",
        "PATH",
    ),
    "accept_noncommercial": _option("Use weights whose licence forbids commercial use."),
    "download": _option("Fetch missing weights from their authors."),
    # demo
    "demo.frames": _option("Frames of the walk; default: 40, of a video 240."),
    "demo.out": _option("Folder for the walk and its run."),
    "demo.camera": _option("ideal: one centre; two-lens: two lenses with a rolling shutter."),
    "path": _option("rectangle, oval or open; with --mesh: a TUM file of poses."),
    "heading": _option("locked or forward."),
    "demo.width": _option("Width of a panorama in pixels; default: 1024, of a video 720."),
    "seed": _option("Seed of the walk's wobble, noise and drift."),
    "mesh": _option("Mesh to walk through in place of the gallery: OBJ, GLB or PLY."),
    "demo.video": _option(
        "Render the walk as a video of eight frames a second and refine it without a trajectory."
    ),
    # add
    "add.out": _RESULT,
    "new": _argument(
        "Folder or video of a recording to add, with trajectory files after it; more recordings "
        "after these.",
        "RECORDING",
    ),
    "fixed": _option("Keep the poses of RUN to the byte; solve new ones against them."),
    # merge
    "merge.out": _option("Folder of the result.", "DIR"),
    "merge.runs": _argument("Folders of finished runs.", "RUN..."),
    "rigid": _option(
        "Move each map as it is; report the covariance of the similarity between them."
    ),
    # remove
    "remove.out": _RESULT,
    "names": _argument("Names of recordings to take out.", "NAME..."),
    # localize
    "localize.out": _option(
        "Folder to write; default: beside the pictures, NAME-localized.", "DIR"
    ),
    "localize.allow_partial": _option(
        "Exit with 0 even if less than nine tenths of the pictures are localised."
    ),
    "localize.images": _argument(
        "Pictures of the run's cameras, or photos: files, folders, videos."
    ),
    "localize.map_number": _option("Number of the map; 1: the largest.", "NUMBER", "--map"),
    "camera_of": _option(
        "Recording whose camera took the pictures; default: their layout and size tell.",
        "RECORDING",
    ),
    "fast": _option("Rest on keypoints alone: half the time, errors about three times as large."),
    # render
    "render.out": _option("Folder to write; default: RUN/renderings."),
    "render.splat": _argument("point_cloud.ply.", "SPLAT"),
    "frame": _option("Frame of the run, by name.", "NAME"),
    # export
    "export.out": _option("Folder to write; default: RUN/FORMAT, of map 2 RUN/FORMAT-map2."),
    "export.masks": _option(
        "files: masks beside the images, by the names that the program reads; alpha, black: images "
        "are painted where masks hide them, too, for programs that read none.",
        "files|alpha|black",
    ),
    "export.gps": _option(
        "GPS positions: CSV, GPX, a video of GoPro or Insta360, or exif (of the frames); export in "
        "metres east, north, up.",
        "FILE",
    ),
    "export.images": _option(
        "cube: six faces of one centre; lenses: ten faces of one lens each, where two lenses were "
        "found; fisheye: the raw fisheyes; panorama: two lenses stitched at the map's depth, else "
        "the frames; auto: lenses for raw fisheyes, else cube.",
        "auto|cube|lenses|fisheye|panorama",
    ),
    "export.map_number": _option(
        "Number of the map to export, as in the run's report; 1: the largest.", "NUMBER", "--map"
    ),
    "export.to": _option(
        "colmap, colmap-flat, colmap-erp, nerfstudio, opensfm, metashape, gltf, ply or tum; or a "
        "program: inria, postshot, brush, lichtfeld, gsplat, 3dgrut, opensplat, nerfstudio, "
        "instant-ngp, 3dgs-deblur, blender.",
        "FORMAT",
    ),
    "export.up": _option("auto: turn the world upright; none: do not."),
    "scale": _option(
        "Metres between the two ends of --between; lens: scale from the lens distance.", "LENGTH"
    ),
    "baseline": _option("Millimetres between the lenses, for --scale lens.", "MM"),
    "between": _option("Two frames, or points x,y,z of the run's world.", "A B"),
    "gps_sigma": _option(
        "With --gps: smallest horizontal sigma of a fix in metres; default: 3.", "M"
    ),
    "gps_offset": _option(
        "With --gps: seconds to add to the file's times to reach the frames' clock.", "SECONDS"
    ),
    "align": _option("True poses: export in their world.", "TRUTH.tum"),
    "align_scan": _option(
        "Scan to align with: PLY, PCD, LAS, LAZ, OBJ or GLB; export in its world and unit.", "SCAN"
    ),
    "export.pairs": _option(
        "With --align-scan: point pairs, one a line: a frame or x,y,z of the run, and X,Y,Z of the "
        "scan.",
        "FILE",
    ),
    "link": _option("Make hard links to unchanged frames, not copies."),
    "without": _option(
        "Frame to leave out; doubted: those that the run's verdict says to leave out. Repeatable.",
        "NAME",
    ),
    "photos": _option(
        "Folder of gsba localize: also write its photos, as cameras of their own.", "DIR"
    ),
    "exposure_ms": _option(
        "Exposure of a frame in milliseconds, for trainers that model motion blur.", "MS"
    ),
    "split": _option(
        "Hold one panorama in eight out of the training, with all its faces; default: if two are "
        "left to train on."
    ),
    "depths": _option(
        "Also write the depths of the map's points in each face, with standard deviations."
    ),
    "exposures": _option(
        "Also estimate how frames are exposed, as EXIF of their images (colmap, colmap-flat)."
    ),
    # evaluate
    "evaluate.gps": _option(
        "With --scan: GPS positions, or exif, that start the alignment.", "FILE"
    ),
    "evaluate.splat": _option("Train splats on the poses and measure held-out frames."),
    "evaluate.up": _option("With --scan: auto = the scan is upright.", "auto"),
    "evaluate.pairs": _option("With --scan: point pairs that start the alignment.", "FILE"),
    "estimate": _argument("A run, or a trajectory file.", "RUN"),
    "depth": _option(
        "True depth maps: also measure by how many pixels pose errors move points.", "DIR"
    ),
    "json_file": _option("File to write the numbers to as well.", "FILE", "--json"),
    "scan": _option("Scan of the place, to measure the run's points against.", "FILE"),
    "against": _option("With --splat: trajectory to compare the run's with; repeatable.", "FILE"),
    # splat
    "splat.frames": _argument("A video, or a folder of frames, as of `gsba refine`."),
    "splat.to": _option(
        "Write a dataset for this program, as in `gsba export`; default: train a splat.", "TRAINER"
    ),
    # extract
    "extract.frames": _option("With --every auto: largest number of frames to keep."),
    "extract.out": _option("Folder to write the frames to.", "FRAMES"),
    "extract.fps": _option("Frames to keep per second; default: 1."),
    "extract.fresh": _option("Replace an earlier extraction."),
    "extract.width": _option("Width of a frame in pixels; default: as the video."),
    "extract.video": _argument("Video: 2:1, .360, or raw of two fisheyes."),
    "every": _option(
        "Keep one of N frames. auto: keep sharp frames with baselines that suit the scene's depth, "
        "which odometry on the video estimates.",
        "N|auto",
    ),
    "at": _option("Keep the frames at the times of this file.", "TRAJECTORY"),
    "sharpest": _option("Keep the sharpest frame of each interval, not the first."),
    "from_s": _option("Seconds to start at.", None, "--from"),
    "to_s": _option("Seconds to end at.", None, "--to"),
    "keep_standing": _option("Also keep frames while the camera stands."),
    # mask
    "mask.frames": _argument("Folder of 2:1 panoramas, tracks or raw fisheyes."),
    "mask.out": _option("Folder to write the masks to.", "DIR"),
    "mask.masks": _option("Masks of your own, merged with the carrier's."),
    # track
    "track.frames": _argument("Video, or folder of 2:1 panoramas or raw fisheyes, in time order."),
    "track.out": _option("Trajectory to write: TUM, poses of all frames.", "FILE"),
    "track.keyframes": _option(
        "Keyframes to write, TUM; default: beside --out, named -keyframes.", "FILE"
    ),
    "track.masks": _option("auto: mask the carrier of the camera; none; or a mask, white = use."),
    "track.timestamps": _option("File with the times of a folder's frames.", "FILE"),
    "track.fps": _option("Frame rate of a folder without times."),
    "track.width": _option(
        "Width in pixels of the panoramas that odometry uses; even.", min=256, max=4096
    ),
    "poses": _option(
        "Maps, statuses and covariances of poses to write, CSV; default: beside --out, named "
        "-poses.",
        "FILE",
    ),
    "report": _option("Report to write, JSON; default: beside --out, named -report.", "FILE"),
    # app
    "root": _argument("Folder whose files can be chosen; runs are written into it."),
    "state": _option("Folder of the queue; default: one for each ROOT in ~/.local/state/gsba/app."),
    # info
    "files": _argument("Videos, folders of frames, pictures, runs."),
    "info.as_json": _option("As JSON, for programs.", None, "--json"),
    # doctor
    "doctor.as_json": _option("As JSON, for reports.", None, "--json"),
    # plot
    "plot.out": _option("Folder or one file to write: PNG, SVG, PDF.", "DIR|FILE"),
    "plot.runs": _argument("Folders of finished runs, or trajectory files.", "RUN..."),
}
