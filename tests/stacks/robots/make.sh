#!/bin/sh
# Makes an environment with RHOT, dex-retargeting, and the robot hands (URDF) that another package carries.
# Usage: make.sh FOLDER. dex-retargeting 0.5 does not say that it needs torch and six.
set -eu
python3 -m venv "$1"
"$1/bin/pip" install --quiet --disable-pip-version-check torch six dex-retargeting dexi-rs "$(dirname "$0")/../../..[record]"
touch "$1/.ready"
