#!/usr/bin/env bash
# A release tried from its upload on: archives go to an index of this machine with twine, are
# installed from there by name into a fresh environment, and run the demo and a part of the tests.
#   packaging/index.sh DIST         DIST holds what packaging/check.sh left there
# Needs Python 3.11 or newer (PYTHON, else python3) and the package index for what gsba needs.
set -euo pipefail

dist=$(cd "$1" && pwd)
work=$(mktemp -d)
python=${PYTHON:-python3}
server=
trap '[ -z "$server" ] || kill "$server"; rm -rf "$work"' EXIT
unset PYTHONPATH
export PIP_ROOT_USER_ACTION=ignore PIP_DISABLE_PIP_VERSION_CHECK=1

echo "== index of this machine, twine upload"
"$python" -m venv "$work/tools"
"$work/tools/bin/pip" install --quiet pypiserver 'twine>=6'
mkdir "$work/packages" "$work/empty"
port=$("$python" -c 'import socket; s = socket.socket(); s.bind(("127.0.0.1", 0)); print(s.getsockname()[1])')
"$work/tools/bin/pypi-server" run -i 127.0.0.1 -p "$port" -P . -a . "$work/packages" >"$work/server.log" 2>&1 &
server=$!
until "$python" -c "import socket; socket.create_connection(('127.0.0.1', $port))" 2>/dev/null; do
  kill -0 "$server" || { cat "$work/server.log"; exit 1; }
  sleep 0.2
done
"$work/tools/bin/twine" upload --non-interactive --disable-progress-bar \
  --repository-url "http://127.0.0.1:$port" -u anyone -p anything "$dist"/*

echo "== pip install gsba, doctor, demo, tests"
"$python" -m venv "$work/fresh"
version=$(basename "$dist"/gsba-*.tar.gz .tar.gz) && version=${version#gsba-}
"$work/fresh/bin/pip" install --quiet --extra-index-url "http://127.0.0.1:$port/simple" \
  "gsba[test,view]==$version"
cd "$work/empty" # so that the installed package is tested, by the tests of the source archive
tar -xzf "$dist/gsba-$version.tar.gz" --strip-components=1 --wildcards '*/tests/*' '*/pyproject.toml'
"$work/fresh/bin/gsba" doctor
"$work/fresh/bin/gsba" --quiet demo --frames 12 --width 512
"$work/fresh/bin/python" -m pytest -q -n 0 tests/trajectory tests/app/test_jobs.py \
  tests/camera/test_calibration.py tests/export/test_other_programs.py tests/test_config.py
echo "== $version installs from an index"
