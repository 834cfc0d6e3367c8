#!/bin/sh
# Installs gsba with what needs no GPU, from Debian's packages and wheels alone: what the Dockerfile
# does, for any Debian 12 or newer.
#   packaging/install.sh SOURCE PREFIX
# Makes the virtual environment PREFIX, checks it, and leaves compiled kernels in PREFIX/kernels.
# Debian's packages are installed by root alone; others must have them.
set -eu

source_folder=$1
prefix=$2
export PIP_ROOT_USER_ACTION=ignore PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_CACHE_DIR=1

if [ "$(id -u)" = 0 ]; then
  export DEBIAN_FRONTEND=noninteractive
  apt-get update -q
  apt-get install -q -y --no-install-recommends python3 python3-venv
  rm -rf /var/lib/apt/lists/*
fi

python3 -m venv "$prefix"
wheels=$(mktemp -d)
trap 'rm -rf "$wheels"' EXIT
"$prefix/bin/pip" wheel --quiet --no-deps --wheel-dir "$wheels" "$source_folder"
"$prefix/bin/pip" install --quiet --only-binary :all: "$(echo "$wheels"/*.whl)[plot,video,view]"

# Kernels are compiled once, here; whoever runs gsba on another processor may add theirs.
mkdir -p "$prefix/kernels"
export NUMBA_CACHE_DIR="$prefix/kernels"
cd "$wheels"
"$prefix/bin/gsba" doctor
"$prefix/bin/gsba" --quiet demo --frames 12 --width 512
chmod -R a+rwX "$prefix/kernels"
