#!/usr/bin/env bash
# Installs RHOT on a Raspberry Pi (role capture) or on the PC (role pc) as systemd services. Safe to run again: that is
# also how it is updated. Never touches an existing rig. See docs/deploy.md.
set -euo pipefail

readonly PROGRAM="${0##*/}"
SOURCE="$(cd -- "$(dirname -- "${BASH_SOURCE[0]}")/.." && pwd)"
readonly SOURCE
# Everything is written below this folder: empty on a real machine, somewhere else when a package or a test is made.
readonly ROOT="${RHOT_INSTALL_ROOT:-}"
readonly PREFIX="$ROOT/opt/rhot"
readonly VENV="$PREFIX/venv"
# The state of the services' own user: "Save" in the page writes there, and nowhere else.
readonly STATE="$ROOT/var/lib/rhot"
readonly RIG="$STATE/rig"
# Where the rig lay until 2026.
readonly FORMER_RIG="$ROOT/etc/rhot"
readonly DEFAULTS="$ROOT/etc/default/rhot"
readonly UNITS="$ROOT/etc/systemd/system"
readonly DROP_INS="$UNITS/rhot-.service.d"
readonly START_DROP_INS="$UNITS/rhot-start.service.d"
readonly TIME_DROP_INS="$UNITS/systemd-time-wait-sync.service.d"
readonly OS_RELEASE="$ROOT/etc/os-release"
readonly PC_SERVICES=(rhot-router.service rhot-fusion.service rhot-ik.service rhot-objects.service
    rhot-feet.service rhot-bridge.service rhot-viewer.service rhot-grasp.service rhot-start.service)
# First version that knows RestartSteps= and RestartMaxDelaySec=.
readonly BACKOFF_VERSION=254

role=""
cameras=()
connect=""
picamera2=yes
dry_run=no
uninstall=no
purge=no

usage() {
    cat <<EOF
Usage: sudo $PROGRAM capture --camera NAME [--camera NAME] [--connect ENDPOINT] [--without-picamera2] [--dry-run]
       sudo $PROGRAM pc [--connect ENDPOINT] [--dry-run]
       sudo $PROGRAM --uninstall [--purge] [--dry-run]

  capture              this machine has cameras: one service rhot-capture@NAME for each
  pc                   this machine runs router, fusion, ik, objects, feet, bridges and the web pages
  --camera NAME        name of a camera in rig.toml, such as left
  --connect ENDPOINT   where the router is, such as tcp/192.168.1.10:7447; kept in /etc/default/rhot
  --without-picamera2  this machine has USB cameras only
  --uninstall          remove services, program and user; keep the rig in /var/lib/rhot
  --purge              with --uninstall: remove the rig, its recordings and /etc/default/rhot, too
  --dry-run            print what would be done and do nothing

Run again to update.
EOF
}

fail() {
    printf '%s: %s\n' "$PROGRAM" "$1" >&2
    exit 1
}

run() {
    if [[ $dry_run == yes ]]; then
        printf '+'
        printf ' %q' "$@"
        printf '\n'
    else
        "$@"
    fi
}

# write_file FILE MODE, content on standard input
write_file() {
    if [[ $dry_run == yes ]]; then
        printf '+ write %s\n' "$1"
        cat >/dev/null
    else
        cat >"$1"
        chmod "$2" "$1"
    fi
}

parse_arguments() {
    while (($#)); do
        case "$1" in
            capture | pc)
                [[ -z $role ]] || fail "one role at a time; run it once for $role and once for $1"
                role="$1"
                ;;
            --camera)
                [[ ${2:-} =~ ^[A-Za-z0-9_.-]{1,64}$ ]] || fail "--camera needs the name of a camera in rig.toml, got '${2:-}'"
                cameras+=("$2")
                shift
                ;;
            --connect)
                [[ ${2:-} =~ ^[a-z-]+/[^[:space:]]+$ ]] || fail "--connect needs an endpoint such as tcp/192.168.1.10:7447, got '${2:-}'"
                connect="$2"
                shift
                ;;
            --without-picamera2) picamera2=no ;;
            --uninstall) uninstall=yes ;;
            --purge) purge=yes ;;
            --dry-run) dry_run=yes ;;
            -h | --help)
                usage
                exit 0
                ;;
            *) fail "unknown argument '$1'; see $PROGRAM --help" ;;
        esac
        shift
    done
    if [[ $uninstall == yes ]]; then
        [[ -z $role ]] || fail "--uninstall removes every role; leave '$role' away"
        return
    fi
    [[ $purge == no ]] || fail "--purge goes with --uninstall only"
    [[ -n $role ]] || fail "say what this machine is: $PROGRAM capture --camera NAME, or $PROGRAM pc (see --help)"
    if [[ $role == capture && ${#cameras[@]} -eq 0 ]]; then
        fail "role capture needs at least one --camera NAME, a camera of rig.toml"
    fi
    if [[ $role == pc && ${#cameras[@]} -gt 0 ]]; then
        fail "--camera goes with the role capture"
    fi
}

check_machine() {
    if [[ $dry_run == no && $(id -u) -ne 0 ]]; then
        fail "needs root; run it with sudo, or look first with --dry-run"
    fi
    command -v systemctl >/dev/null || fail "this machine has no systemd, so there is nothing to install units into; docs/deploy.md shows the other ways"
    [[ $uninstall == no ]] || return 0
    [[ -f $SOURCE/pyproject.toml ]] || fail "$SOURCE is no checkout of RHOT (no pyproject.toml); run the script from inside one"
    if ! grep -Eqs '^ID(_LIKE)?=.*(debian|raspbian|ubuntu)' "$OS_RELEASE"; then
        fail "only Debian and its relatives (Raspberry Pi OS, Ubuntu) are supported, not what $OS_RELEASE says; docs/deploy.md shows the steps by hand"
    fi
    case "$(uname -m)" in
        aarch64 | x86_64) ;;
        *) fail "needs a 64-bit system, this is $(uname -m); OpenCV and Zenoh have no packages for it. Install the 64-bit Raspberry Pi OS" ;;
    esac
    command -v python3 >/dev/null || fail "python3 is missing; install it with: apt-get install python3"
    python3 -c 'import sys; sys.exit(sys.version_info < (3, 11))' ||
        fail "needs Python 3.11 or newer, $(python3 --version) is installed; Raspberry Pi OS has it from bookworm on"
}

install_packages() {
    local wanted=(python3-venv) missing=() package
    if [[ $role == capture && $picamera2 == yes ]]; then
        wanted+=(python3-picamera2)
    fi
    for package in "${wanted[@]}"; do
        dpkg-query --show --showformat='${db:Status-Status}' "$package" 2>/dev/null | grep -qx installed || missing+=("$package")
    done
    if ((${#missing[@]})); then
        run apt-get update
        run apt-get install --yes --no-install-recommends "${missing[@]}" ||
            fail "apt-get could not install ${missing[*]}; python3-picamera2 exists on Raspberry Pi OS only (other machines: --without-picamera2)"
    fi
}

install_user() {
    if ! id rhot >/dev/null 2>&1; then
        run useradd --system --user-group --no-create-home --home-dir /nonexistent --shell /usr/sbin/nologin rhot
    fi
}

install_program() {
    local constraints=() extra="$role"
    run install -d -m 0755 "$PREFIX" "$PREFIX/share"
    if [[ $role == capture && $picamera2 == yes ]]; then
        # picamera2 and libcamera exist as system packages only. Done every time: it leaves what is there in place.
        run python3 -m venv --system-site-packages "$VENV"
    elif [[ ! -x $VENV/bin/python ]]; then
        run python3 -m venv "$VENV"
    fi
    if [[ -f $SOURCE/constraints.txt ]]; then
        constraints=(--constraint "$SOURCE/constraints.txt")
    fi
    run "$VENV/bin/python" -m pip install --quiet --upgrade "${constraints[@]}" "${SOURCE}[$extra]"
    if [[ $role == capture && $picamera2 == yes ]]; then
        # The system's simplejpeg is built for numpy 1 on bookworm and breaks picamera2 beside the numpy 2 we need
        # (raspberrypi/picamera2#1211); one of our own in front of it does not.
        run "$VENV/bin/python" -m pip install --quiet --upgrade --ignore-installed --no-deps 'simplejpeg>=1.8.1'
        run "$VENV/bin/python" -c 'import picamera2' ||
            fail "picamera2 does not load beside our packages (see above); try: $VENV/bin/python -c 'import picamera2'"
    fi
    if [[ $role == pc && ! -e $SOURCE/services/viewer/rhot_viewer/static/index.html ]]; then
        # npm is not run as root.
        printf '%s: the page Grasp is not built; run "make web" in %s (needs node and npm), then this script again\n' "$PROGRAM" "$SOURCE" >&2
    fi
    run install -m 0644 "$SOURCE/docs/deploy.md" "$PREFIX/share/deploy.md"
}

install_rig() {
    run install -d -m 0755 "$STATE"
    if [[ -e $RIG/rig.toml ]]; then
        printf 'keeping the rig in %s\n' "$RIG"
    elif [[ -e $FORMER_RIG/rig.toml ]]; then
        run cp -R "$FORMER_RIG" "$RIG"
        printf 'copied the rig from %s, which is read no longer, to %s\n' "$FORMER_RIG" "$RIG"
    else
        run "$VENV/bin/rhot" init "$RIG"
    fi
    # Whoever has put files there: the services write as this user.
    run chown -R rhot:rhot "$STATE"
    if [[ -e $DEFAULTS ]]; then
        printf 'keeping %s\n' "$DEFAULTS"
        if [[ -n $connect ]] && ! grep -qxF "RHOT_CONNECT=$connect" "$DEFAULTS"; then
            printf '%s: %s does not say RHOT_CONNECT=%s; change it there if you want that\n' "$PROGRAM" "$DEFAULTS" "$connect" >&2
        fi
        return
    fi
    run install -d -m 0755 "$(dirname "$DEFAULTS")"
    write_file "$DEFAULTS" 0644 <<EOF
# Settings of this machine for all RHOT services; they win over rig.toml. After a change: systemctl restart rhot.target
# RHOT_CONNECT: the Zenoh router, such as tcp/192.168.1.10:7447; several are separated by commas.
# RHOT_NAMESPACE: keeps several rigs on one network apart.
# RHOT_PAGE_HOST=0.0.0.0: other machines may open the pages, with one of the links in /var/lib/rhot/page.links
#   and grasp.links.
${connect:+RHOT_CONNECT=$connect}
EOF
}

install_units() {
    local files=() enable=() file camera version
    if [[ $role == capture ]]; then
        files=(rhot.target rhot-capture@.service)
        for camera in "${cameras[@]}"; do
            enable+=("rhot-capture@$camera.service")
        done
    else
        files=(rhot.target "${PC_SERVICES[@]}")
        enable=("${PC_SERVICES[@]}")
    fi
    run install -d -m 0755 "$UNITS" "$DROP_INS" "$START_DROP_INS" "$TIME_DROP_INS"
    for file in "${files[@]}"; do
        run install -m 0644 "$SOURCE/deploy/systemd/$file" "$UNITS/$file"
    done
    run install -m 0644 "$SOURCE/deploy/systemd/rhot-.service.d/hardening.conf" "$DROP_INS/hardening.conf"
    run install -m 0644 "$SOURCE/deploy/systemd/rhot-start.service.d/oneshot.conf" "$START_DROP_INS/oneshot.conf"
    run install -m 0644 "$SOURCE/deploy/systemd/systemd-time-wait-sync.service.d/rhot.conf" "$TIME_DROP_INS/rhot.conf"
    version="$(systemctl --version | sed -n '1s/^systemd \([0-9]*\).*/\1/p')"
    if [[ ${version:-0} -ge $BACKOFF_VERSION ]]; then
        run install -m 0644 "$SOURCE/deploy/systemd/rhot-.service.d/backoff.conf" "$DROP_INS/backoff.conf"
    else
        run rm -f "$DROP_INS/backoff.conf"
    fi
    run systemctl daemon-reload
    enable_time_wait
    run systemctl enable --quiet rhot.target "${enable[@]}"
    # Not waiting: a service is ready when it has reached the router, which may be switched off right now.
    run systemctl start --no-block rhot.target
    run systemctl restart --no-block "${enable[@]}"
    if [[ $role == capture ]]; then
        report_other_cameras
    fi
}

# A camera under a new name leaves the service of its old name behind, which then waits for a camera that nobody has. It
# may as well be a second camera that was installed earlier, so it is only reported.
report_other_cameras() {
    local link unit
    for link in "$UNITS"/rhot.target.wants/rhot-capture@*.service; do
        unit="${link##*/}"
        if [[ -L $link && " ${cameras[*]/#/rhot-capture@} " != *" ${unit%.service} "* ]]; then
            printf '%s: %s was installed earlier and still runs; if it is not needed: sudo systemctl disable --now %s\n' \
                "$PROGRAM" "$unit" "$unit" >&2
        fi
    done
}

# The services come after time-sync.target, which is reached at once unless a unit waits for the clock in front of it.
enable_time_wait() {
    local unit
    for unit in chrony-wait.service systemd-time-wait-sync.service; do
        if systemctl cat "$unit" >/dev/null 2>&1; then
            run systemctl enable --quiet "$unit"
            return
        fi
    done
    printf '%s: nothing here waits for the clock to be set (install systemd-timesyncd or chrony); the rig starts without\n' "$PROGRAM" >&2
}

uninstall_all() {
    local link names=()
    for link in "$UNITS"/rhot.target.wants/rhot-*.service; do
        [[ -e $link || -L $link ]] && names+=("${link##*/}")
    done
    if [[ -e $UNITS/rhot.target ]]; then
        run systemctl disable --quiet --now rhot.target "${names[@]}"
    fi
    run rm -f "$UNITS/rhot.target" "$UNITS/rhot-capture@.service" "${PC_SERVICES[@]/#/$UNITS/}"
    run rm -rf "$DROP_INS" "$START_DROP_INS" "$TIME_DROP_INS" "$PREFIX"
    run systemctl daemon-reload
    if id rhot >/dev/null 2>&1; then
        run userdel rhot
    fi
    if [[ $purge == yes ]]; then
        run rm -rf "$STATE" "$DEFAULTS"
    elif [[ -e $STATE ]]; then
        printf 'keeping the rig in %s (remove it with --uninstall --purge)\n' "$STATE"
    fi
}

main() {
    parse_arguments "$@"
    check_machine
    if [[ $uninstall == yes ]]; then
        uninstall_all
        [[ $dry_run == yes ]] || echo "RHOT is removed."
        return
    fi
    install_packages
    install_user
    install_program
    install_rig
    install_units
    if [[ $dry_run == no ]]; then
        echo "RHOT ($role) is installed; look with: systemctl status 'rhot-*', journalctl -fu 'rhot-*', rhot doctor --rig /var/lib/rhot/rig"
    fi
}

main "$@"
