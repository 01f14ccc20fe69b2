#!/usr/bin/env bash
# Builds the wheel, the source distribution and the documentation's site, checks what is in them, and starts them as their
# users will; as root with mmdebstrap also in a Debian that has nothing but Python.
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
"$work/tools/bin/pip" install --quiet --disable-pip-version-check build twine hatchling mkdocs-material uv
NO_MKDOCS_2_WARNING=1 "$work/tools/bin/mkdocs" build --quiet --strict --site-dir "$work/site"
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

# As `uvx --from WHEEL rhot` and pipx do: an environment of its own, made by the tool.
UV_TOOL_DIR="$work/uv" UV_TOOL_BIN_DIR="$work/bin" "$work/tools/bin/uv" tool install --quiet --python "$python" "$wheel[sim]"
(cd "$work" && "$work/bin/rhot" -q sim --headless --duration 5 --rate 30)

if [ "$(id -u)" = 0 ] && command -v mmdebstrap >/dev/null; then
    echo "release: rhot[sim] in a fresh Debian, from pip install to both pages"
    mmdebstrap --quiet --variant=apt --include=python3,python3-venv,ca-certificates bookworm "$work/root"
    cp /etc/resolv.conf "$work/root/etc/"
    cp -L /etc/ssl/certs/ca-certificates.crt "$work/root/etc/ssl/certs/"
    cp "$wheel" deploy/fresh_start.sh "$work/root/root/"
    env -u PIP_FIND_LINKS unshare --mount --pid --fork --mount-proc="$work/root/proc" \
        chroot "$work/root" sh /root/fresh_start.sh
else
    echo "release: not tried in a fresh Debian, which takes root and mmdebstrap" >&2
fi

tar -C "$work" -czf "$folder/site.tar.gz" site
ls -l "$folder"
