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
    masks: bool = True  # False: it reads none


PROGRAMS = {
    "inria": Program(ExportFormat.COLMAP_FLAT, "python train.py -s {out} --eval", masks=False),
    "postshot": Program(
        ExportFormat.COLMAP_FLAT, "drop {out}/images and {out}/sparse/0 into Postshot together"
    ),
    "brush": Program(ExportFormat.COLMAP_FLAT, "brush {out} --eval-split-every 8"),
    "lichtfeld": Program(
        ExportFormat.COLMAP_FLAT,
        "LichtFeld-Studio -d {out} -o {out}-splat --eval --mask-mode ignore",
    ),
    "gsplat": Program(
        ExportFormat.COLMAP_FLAT,
        "python examples/simple_trainer.py default --data_dir {out} --data_factor 1",
        masks=False,
    ),
    "opensplat": Program(ExportFormat.COLMAP_FLAT, "opensplat {out} -n 30000", masks=False),
    "nerfstudio": Program(ExportFormat.NERFSTUDIO, "ns-train splatfacto --data {out}"),
    "instant-ngp": Program(
        ExportFormat.NERFSTUDIO, "instant-ngp {out}/transforms.json", masks=False
    ),
    "3dgs-deblur": Program(ExportFormat.NERFSTUDIO, "python train.py {out}"),
    "blender": Program(ExportFormat.GLTF, "blender --python {out}/open_in_blender.py"),
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
    if name not in PROGRAMS:
        return []
    program = PROGRAMS[name]
    lines = [f"{name}: {program.start.format(out=out)}"]
    if (out / "masks").is_dir() and not program.masks:
        lines.append(f"{name} reads no masks: it trains on pixels that they hide")
    return lines
