#!/usr/bin/env bash
# nerfstudio 1.1.5, COLMAP parser: it asks for a file `validation_list.txt`, and opens `val_list.txt`.
# With the first beside train_list.txt the split "val" is an error that names no file. With the second
# alone the validation images are held out of nothing: training takes its own nine tenths of all images.
# Seen: RuntimeError, and 4 of 4 listed images in the training.
# The parser's method is run as the package holds it, without torch, which it does not use.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet numpy==2.4.6
"$work/venv/bin/pip" install --quiet --no-deps nerfstudio==1.1.5
"$work/venv/bin/python" - "$work" <<'PROGRAM'
import ast
import importlib.util
import sys
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np

package = Path(importlib.util.find_spec("nerfstudio").submodule_search_locations[0])
names = {"np": np, "CONSOLE": MagicMock()}

def load(path, name):
    """A function of the package, by its own source."""
    tree = ast.parse((package / path).read_text())
    (found,) = (n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef) and n.name == name)
    found.decorator_list = []
    exec(compile(ast.Module([found], []), path, "exec"), names)
    return names[name]

names |= {"List": list, "Tuple": tuple, "Path": Path, "math": __import__("math")}
load("data/utils/dataparsers_utils.py", "get_train_eval_split_fraction")
indices = load("data/dataparsers/colmap_dataparser.py", "_get_image_indices")

def parser(folder, lists):
    folder.mkdir()
    for name, images in lists.items():
        (folder / name).write_text("".join(f"{image}\n" for image in images))
    config = SimpleNamespace(
        data=folder, images_path=Path("images"), eval_mode="fraction", train_split_fraction=0.9
    )
    return SimpleNamespace(config=config), [folder / "images" / image for image in every]

every = [f"{n:03d}.png" for n in range(40)]
held, rest = every[::10], [image for image in every if image not in every[::10]]
home = Path(sys.argv[1])
both = {"train_list.txt": rest, "validation_list.txt": held}
try:
    indices(*parser(home / "both", both), "val")
    raise SystemExit("validation_list.txt is read")
except RuntimeError as error:
    print(f"train_list.txt and validation_list.txt: {error}")
one, files = parser(home / "alone", {"val_list.txt": held})
training = {files[n].name for n in indices(one, files, "train")}
print(f"val_list.txt alone: {len(training & set(held))} of {len(held)} of its images are trained on")
assert training & set(held)
PROGRAM
