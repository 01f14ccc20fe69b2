#!/bin/sh
# Makes a Debian with an OpenXR loader, runtime, validation layer and programs, and a C compiler with its sanitizers.
# Usage: make.sh FOLDER CONSTRAINTS PIP
set -eu
folder=$1
pip=$3
rm -rf "$folder"
mmdebstrap --quiet --variant=apt '--aptopt=Acquire::Languages "none"' '--dpkgopt=path-exclude=/usr/share/doc/*' \
    --include=monado-service,libopenxr1-monado,libopenxr-loader1,libopenxr-utils,openxr-layer-corevalidation \
    --include=libopenxr-dev,mesa-vulkan-drivers,python3,python3-numpy,gcc,libc6-dev,libasan8,libtsan2,libubsan1 \
    trixie "$folder"
# Without what they depend on: on Linux pyopenxr only looks at pyopengl's names.
"$pip" install --quiet --disable-pip-version-check --no-deps --target "$folder/opt/py" pyopenxr pyopengl
# For the root's Python, which is newer than the one that may run this.
"$pip" install --quiet --disable-pip-version-check --no-deps --python-version 3.13 --only-binary :all: \
    --target "$folder/opt/isaac" isaacteleop || echo "no Isaac Teleop for this machine" >&2
touch "$folder/.ready"
