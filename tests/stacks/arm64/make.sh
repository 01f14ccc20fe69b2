#!/bin/sh
# Makes what an emulated ARM program needs: Debian's Python for arm64, unpacked and not configured, so that neither root
# nor binfmt is needed, and what RHOT needs from PyPI. Usage: make.sh FOLDER CONSTRAINTS PIP
set -eu
folder=$1
constraints=$2
pip=$3
rm -rf "$folder"
mmdebstrap --quiet --arch=arm64 --variant=extract --include=python3-minimal,libpython3-stdlib,libstdc++6,zlib1g \
    trixie "$folder"
[ -e "$folder/lib" ] || ln -s usr/lib "$folder/lib"
"$pip" install --quiet --disable-pip-version-check --target "$folder/opt/rhot" --constraint "$constraints" \
    --platform manylinux_2_28_aarch64 --platform manylinux_2_17_aarch64 --platform manylinux2014_aarch64 \
    --python-version 3.13 --implementation cp --abi cp313 --abi abi3 --only-binary=:all: \
    click eclipse-zenoh msgpack numpy opencv-python-headless pydantic rich tomlkit
# From 7.2 on the interface of plugins is version 1, from 8.2 on version 2 and later, which still has these functions.
version=$(qemu-aarch64 --version | sed -n 's/^qemu-aarch64 version \([0-9]*\).*/\1/p')
cc -std=c11 -D_GNU_SOURCE "-DVERSION=$([ "$version" -lt 8 ] && echo 1 || echo 2)" -Wall -Wextra -Werror -O2 -shared \
    -fPIC "$(dirname "$0")/count.c" -o "$folder/count.so"
