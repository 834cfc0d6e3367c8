"""Programs by name: which export each reads (docs/exports.md), and how it is started on that."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import get_args

from gsba.export.dataset import MASK_FILES, MaskStyle, Paint
from gsba.export.formats import ExportFormat, ExportOptions
from gsba.log import GsbaError


@dataclass(frozen=True, slots=True)
class Program:
    """A program that reads an export."""

    to: ExportFormat
    start: str  # how it reads the folder {out}; {split} = by which option it holds images out
    split: str = ""  # that option, left out where nothing is held out
    masks: MaskStyle | None = MASK_FILES  # None = it reads none
    cameras: tuple[str, ...] = ()  # COLMAP's camera models that it reads; () = all that are written
    alpha: bool = True  # False: it cannot read images with an alpha channel
    panoramas: bool = True  # False: it takes panoramas beside faces for pinholes


PROGRAMS = {
    "inria": Program(
        ExportFormat.COLMAP_FLAT,
        "python train.py -s {out}{split}",
        split=" --eval",
        masks=None,
        cameras=("PINHOLE",),
    ),
    "postshot": Program(
        ExportFormat.COLMAP_FLAT, "drop {out}/images and {out}/sparse/0 into Postshot together"
    ),
    "brush": Program(ExportFormat.COLMAP_FLAT, "brush {out}{split}", split=" --eval-split-every 8"),
    "lichtfeld": Program(
        ExportFormat.COLMAP_FLAT,
        "LichtFeld-Studio -d {out} -o {out}-splat{split} --mask-mode ignore",
        split=" --eval",
    ),
    "gsplat": Program(
        ExportFormat.COLMAP_FLAT,
        "python examples/simple_trainer.py default --data_dir {out} --data_factor 1",
        masks=None,
    ),
    "3dgrut": Program(
        ExportFormat.COLMAP_FLAT,
        "python train.py --config-name apps/colmap_3dgut.yaml path={out} out_dir={out}-splat "
        "experiment_name=gsba dataset.downsample_factor=1{split}",
        split=" dataset.test_split_interval=8",
        masks=MaskStyle(path="{folder}/{stem}_mask.png"),
        cameras=("PINHOLE", "OPENCV_FISHEYE"),
        alpha=False,
    ),
    "opensplat": Program(
        ExportFormat.COLMAP_FLAT, "opensplat {out} -n 30000", masks=None, cameras=("PINHOLE",)
    ),
    "nerfstudio": Program(ExportFormat.NERFSTUDIO, "ns-train splatfacto --data {out}"),
    "instant-ngp": Program(
        ExportFormat.NERFSTUDIO,
        "instant-ngp {out}/transforms.json",
        masks=MaskStyle(path="{folder}/dynamic_mask_{stem}.png", hidden=255),
        panoramas=False,
    ),
    "3dgs-deblur": Program(ExportFormat.NERFSTUDIO, "python train.py {out}"),
    "blender": Program(ExportFormat.GLTF, "blender --python {out}/open_in_blender.py"),
}


def format_of(name: str) -> ExportFormat:
    """Format of a name, which is a format's or a program's. Raises GsbaError: the name is neither,
    or its program reads splats only."""
    if name in PROGRAMS:
        return PROGRAMS[name].to
    if name == "supersplat":
        raise GsbaError(
            "--to supersplat: it edits splats and trains none: gsba train RUN writes "
            "RUN/splat/refined/point_cloud.ply, which it opens"
        )
    if name not in list(ExportFormat):
        known = ", ".join(dict.fromkeys([*ExportFormat, *PROGRAMS]))
        raise GsbaError(f"--to {name} is not known: use one of {known}")
    return ExportFormat(name)


def options_for(name: str, options: ExportOptions, paint: str = "files") -> ExportOptions:
    """Options of an export with masks and cameras as the program of this name reads them.

    Args:
        name: of a program or a format.
        paint: the option `--masks`.

    Raises:
        GsbaError: there is no such value of `--masks`, or the program cannot read such images.
    """
    if paint not in get_args(Paint):
        raise GsbaError(f"--masks {paint} is not known: use one of {', '.join(get_args(Paint))}")
    program = PROGRAMS.get(name)
    if program is None:
        return replace(options, masks=MaskStyle(paint))
    if paint == "alpha" and not program.alpha:
        raise GsbaError(f"--masks alpha: {name} reads no images with an alpha channel: use files")
    style = replace(program.masks or MASK_FILES, paint=paint)
    cameras, panoramas = program.cameras, program.panoramas
    return replace(options, masks=style, cameras=cameras, panoramas=panoramas)


_DEPTHS = {  # how programs take depths
    "nerfstudio": "takes depths by ns-train depth-nerfacto --data {out}; splatfacto takes none",
    "gsplat": "takes depths from {out}/sparse/0, by --depth_loss",
    "inria": "takes dense depths, which its make_depth_scale.py fits to {out}/sparse/0",
}
_READ_EXPOSURES = ("gsplat", "3dgrut")


def how_to_start(name: str, out: Path, paint: str = "files") -> list[str]:
    """Lines on how the program of this name reads an export; [] = it is the name of a format."""
    if name not in PROGRAMS:
        return []
    program = PROGRAMS[name]
    split = program.split if (out / "test_list.txt").is_file() else ""
    lines = [f"{name}: {program.start.format(out=out, split=split)}"]
    if (out / "masks").is_dir() and program.masks is None and paint == "files":
        lines.append(
            f"{name} reads no masks: it trains on pixels that they hide; --masks alpha or black "
            "paints these"
        )
    if (out / "sparse_depths").is_dir():
        reads = _DEPTHS.get(name, "reads none of the depths").format(out=out)
        lines.append(f"{name} {reads}")
    if (out / "exposures.json").is_file() and name not in _READ_EXPOSURES:
        lines.append(f"{name} reads no exposures")
    return lines
