#!/usr/bin/env bash
# The Dockerfile's steps where no container can be built: a bare Debian under chroot, the source
# copied into it, packaging/install.sh, then the demo as who is not root.
#   packaging/fresh_root.sh
# Needs root and debootstrap. SUITE and MIRROR choose another Debian.
set -euo pipefail

source_folder=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
work=$(mktemp -d)
trap 'rm -rf --one-file-system "$work"' EXIT

debootstrap --variant=minbase "${SUITE:-bookworm}" "$work" "${MIRROR:-http://deb.debian.org/debian}" \
  >"$work.log" || { cat "$work.log"; exit 1; }
rm -f "$work.log"
chmod 755 "$work"
# How this machine reaches its package indices.
certificates=${PIP_CERT:-/etc/ssl/certs/ca-certificates.crt}
cp -L "$certificates" "$work/etc/certificates.pem"
for file in /etc/resolv.conf /etc/pip.conf; do
  if [ -e "$file" ]; then cp -L "$file" "$work$file"; fi
done
cp -r /etc/apt/apt.conf.d/. "$work/etc/apt/apt.conf.d/"
mkdir "$work/source" "$work/work"
tar -C "$source_folder" --exclude=.git -cf - . | tar -C "$work/source" -xf -
chmod 1777 "$work/work"

unset PYTHONPATH
trusted=/etc/certificates.pem # whatever Debian's own packages make of /etc/ssl
chroot "$work" env PIP_CERT=$trusted REQUESTS_CA_BUNDLE=$trusted SSL_CERT_FILE=$trusted \
  sh /source/packaging/install.sh /source /opt/gsba
chroot --userspec=65534:65534 "$work" env HOME=/nonexistent NUMBA_CACHE_DIR=/opt/gsba/kernels \
  sh -c 'cd /work && /opt/gsba/bin/gsba demo --frames 12 --width 512'
