"""Programs by name: which export each reads, and how it is started on that."""

from dataclasses import dataclass
from pathlib import Path

from gsba.export.formats import ExportFormat
from gsba.log import GsbaError


@dataclass(frozen=True, slots=True)
class Program:
    """A program that reads an export, by its public documentation."""

    to: ExportFormat
    start: str  # how it reads the folder {out}


PROGRAMS = {
    "inria": Program(ExportFormat.COLMAP_FLAT, "python train.py -s {out} --eval"),
    "postshot": Program(
        ExportFormat.COLMAP_FLAT, "drop {out}/images and {out}/sparse/0 into Postshot together"
    ),
    "brush": Program(ExportFormat.COLMAP_FLAT, "brush {out}"),
    "lichtfeld": Program(ExportFormat.COLMAP_FLAT, "LichtFeld-Studio -d {out} -o {out}-splat"),
    "gsplat": Program(
        ExportFormat.COLMAP_FLAT,
        "python examples/simple_trainer.py default --data_dir {out} --data_factor 1",
    ),
    "opensplat": Program(ExportFormat.COLMAP_FLAT, "opensplat {out} -n 30000"),
    "nerfstudio": Program(ExportFormat.NERFSTUDIO, "ns-train splatfacto --data {out}"),
    "instant-ngp": Program(ExportFormat.NERFSTUDIO, "instant-ngp {out}"),
    "3dgs-deblur": Program(ExportFormat.NERFSTUDIO, "python train.py {out}"),
    "blender": Program(ExportFormat.GLTF, "File > Import > glTF 2.0: {out}/scene.glb"),
}


def format_of(name: str) -> ExportFormat:
    """Format of a name, which is a format's or a program's.

    Raises:
        GsbaError: the name is neither, or its program reads splats only.
    """
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


def how_to_start(name: str, out: Path) -> list[str]:
    """Lines on how the program of this name reads an export; [] = it is the name of a format."""
    return [f"{name}: {PROGRAMS[name].start.format(out=out)}"] if name in PROGRAMS else []
