#!/bin/sh
# In a fresh Debian with its Python alone: how long from `pip install` until both pages of `rhot sim` are there.
set -eu
cd /root
export HOME=/root LANG=C.UTF-8
begun=$(date +%s)
python3 -m venv v
v/bin/pip install --quiet --disable-pip-version-check "$(echo /root/rhot*.whl)[sim]"
echo "installed after $(($(date +%s) - begun)) s"
v/bin/rhot -q sim >log 2>&1 &
v/bin/python - <<'END'
import time
import urllib.request

wanted, until = {8080, 8081}, time.monotonic() + 75.0
while wanted and time.monotonic() < until:
    time.sleep(0.2)
    for port in sorted(wanted):
        try:
            urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=2.0).read()
        except OSError:
            continue
        wanted.discard(port)
if wanted:
    raise SystemExit(f"no page on {wanted}")
END
took=$(($(date +%s) - begun))
echo "both pages after $took s"
# SIGTERM is not heeded by the first processes of a namespace; nothing of it outlives this script anyway.
kill -9 $!
[ "$took" -le 120 ]
