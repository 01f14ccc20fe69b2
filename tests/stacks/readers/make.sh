#!/bin/sh
# Makes an environment of programs that read what we write, apart from ours, because they want another numpy.
# Usage: make.sh FOLDER. Blender has a wheel for one version of Python at a time; where it has none, it is left out.
set -eu
python3 -m venv "$1"
"$1/bin/pip" install --quiet --disable-pip-version-check 'vmcp[osc4py3]' opensim bids-validator-deno nwbinspector ndx-pose
"$1/bin/pip" install --quiet --disable-pip-version-check 'bpy>=5' || echo "no Blender for this Python" >&2
"$1/bin/pip" install --quiet --disable-pip-version-check isaacteleop || echo "no Isaac Teleop for this Python" >&2
touch "$1/.ready"
