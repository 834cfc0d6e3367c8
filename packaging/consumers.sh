#!/usr/bin/env bash
# Exports read by programs they are for: pytest -m consumers, in an environment of its own that adds
# pinned readers to the packages of the current one (PYTHON, else python3). Readers that need more
# are tested where that is installed (torch, open3d). Without the package index nothing is run.
#   packaging/consumers.sh
set -euo pipefail

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python=${PYTHON:-python3}
export PIP_ROOT_USER_ACTION=ignore PIP_DISABLE_PIP_VERSION_CHECK=1

"$python" -m venv "$work/venv"
here=$("$work/venv/bin/python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')
"$python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))' >"$here/current.pth"
readers=(evo==1.38.1 jaxtyping==0.3.11 appdirs==1.4.4)
if ! "$work/venv/bin/pip" install --quiet --retries 1 --timeout 20 "${readers[@]}" ||
  ! "$work/venv/bin/pip" install --quiet --retries 1 --timeout 20 --no-deps nerfstudio==1.1.5; then
  echo "not run: the package index cannot be reached, or lacks one of the readers"
  exit 0
fi
if command -v npm >/dev/null && npm install --silent --no-audit --no-fund --fetch-retries 0 --prefix "$work/node" \
  gltf-validator@2.0.0-dev.3.10 @playcanvas/splat-transform@2.7.1; then
  export GSBA_NODE_MODULES="$work/node/node_modules"
fi
# Blender has its own NumPy, older than ours, and wants Python 3.11.
if "$python" -m venv "$work/blender" &&
  "$work/blender/bin/pip" install --quiet --retries 1 --timeout 20 bpy==4.5.15; then
  export BLENDER_PYTHON="$work/blender/bin/python"
fi
cd "$root"
"$work/venv/bin/python" -m pytest -n 0 -m consumers -rs tests/export/test_consumers.py tests/export/test_blender.py
