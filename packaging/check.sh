#!/usr/bin/env bash
# What a release must pass: wheel and source archive are built, are well-formed, and the wheel,
# installed alone in a fresh environment, runs the demo outside of the source. The source archive
# alone gives the same wheel, file by file.
#   packaging/check.sh [DIST]       archives are left in DIST, if it is given
# Needs Python 3.11 or newer (PYTHON, else python3) and the package index.
set -euo pipefail

source_folder=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
dist=${1:-$work/dist}
python=${PYTHON:-python3}
unset PYTHONPATH
export PIP_ROOT_USER_ACTION=ignore PIP_DISABLE_PIP_VERSION_CHECK=1

mkdir -p "$dist" "$work/source"
dist=$(cd "$dist" && pwd)
cd "$source_folder"
if git rev-parse --git-dir >/dev/null 2>&1; then # what is committed or to be, and nothing else
  git ls-files -z --cached --others --exclude-standard --deduplicate |
    tar --null --ignore-failed-read --files-from=- -cf - | tar -xf - -C "$work/source"
else
  cp -a . "$work/source"
fi

echo "== build, twine check --strict"
"$python" -m venv "$work/tools"
"$work/tools/bin/pip" install --quiet 'build>=1.2' 'twine>=6'
"$work/tools/bin/python" -m build --outdir "$work/built" "$work/source" >"$work/build.log" ||
  { cat "$work/build.log"; exit 1; }
"$work/tools/bin/twine" check --strict "$work"/built/*

wheel=$(echo "$work"/built/*.whl)
echo "== $(basename "$wheel"): installed alone, doctor, demo"
"$python" -m venv "$work/fresh"
"$work/fresh/bin/pip" install --quiet "$wheel"
"$work/fresh/bin/pip" check
mkdir "$work/empty"
(
  cd "$work/empty"
  "$work/fresh/bin/gsba" doctor
  "$work/fresh/bin/gsba" --quiet demo --frames 12 --width 512
  "$work/fresh/bin/python" -c '
import pathlib, gsba, factors
for package in (gsba, factors):
    folder = pathlib.Path(package.__file__).parent
    assert (folder / "py.typed").is_file() and "site-packages" in folder.parts, folder
'
)

source_archive=$(echo "$work"/built/*.tar.gz)
echo "== $(basename "$source_archive"): gives the same wheel"
"$work/fresh/bin/pip" wheel --quiet --no-deps --wheel-dir "$work/again" "$source_archive"
"$python" -c '
import sys, zipfile
first, second = ({e.filename: e.CRC for e in zipfile.ZipFile(p).infolist()} for p in sys.argv[1:])
assert first == second, set(first.items()) ^ set(second.items())
' "$wheel" "$work"/again/*.whl
cp "$wheel" "$source_archive" "$dist"
echo "== fit for release: $(cd "$dist" && echo *)"
