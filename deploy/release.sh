#!/usr/bin/env bash
# Builds the wheel and the source distribution, checks what is in them, and starts them as their users will.
# Usage: release.sh PYTHON FOLDER. `make web` has to come first: a wheel without the page Grasp is refused.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
python=$1
folder=$2
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

if ! git diff --quiet HEAD; then
    echo "release: files differ from the last commit, which the wheel would name; commit them first" >&2
    exit 1
fi
rm -rf "$folder"
"$python" -m venv "$work/tools"
"$work/tools/bin/pip" install --quiet --disable-pip-version-check build twine hatchling
"$work/tools/bin/python" -m build --no-isolation --outdir "$folder" . >"$work/log" 2>&1 || { cat "$work/log" >&2; exit 1; }
"$work/tools/bin/twine" check --strict "$folder"/*
wheel=$(echo "$folder"/*.whl)

"$python" -m zipfile --list "$wheel" >"$work/list"
for wanted in rhot_viewer/static/index.html rhot_viewer/static/grasp.js rhot_viewer/static/style.css \
    rhot_bridge/openxr/rhot_layer.c rhot_bridge/openxr/rhot_hands.h rhot/commit; do
    grep -q "^$wanted " "$work/list" || {
        echo "release: $wheel lacks $wanted" >&2
        exit 1
    }
done

# Each role alone, as it is installed on a machine of its own.
for extra in "" capture fusion ik objects feet viewer bridge record pc sim; do
    echo "release: rhot${extra:+[$extra]} in a fresh environment"
    "$python" -m venv "$work/env"
    "$work/env/bin/pip" install --quiet --disable-pip-version-check "$wheel${extra:+[$extra]}"
    (cd "$work" && "$work/env/bin/rhot" --version && "$work/env/bin/rhot" --help >"$work/log")
    case $extra in
    sim) (cd "$work" && "$work/env/bin/rhot" -q sim --headless --duration 5 --rate 30) ;;
    "" | record | pc) ;;
    *) "$work/env/bin/rhot" "$extra" --help >"$work/log" ;;
    esac
    rm -rf "$work/env"
done
ls -l "$folder"
