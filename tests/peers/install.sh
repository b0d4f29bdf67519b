#!/usr/bin/env bash
# Installs what tests/peers/run.sh and late_commit.sh need and this machine lacks: mbpoll, socat and ip (apt), pymodbus and pyserial (pip,
# pinned, in a virtual environment outside the clone). Does nothing when all is there.
set -euo pipefail
pymodbus=3.16.1
pyserial=3.5
cache=${XDG_CACHE_HOME:-$HOME/.cache}/benderd-tests
venv=$cache/pymodbus-$pymodbus

if command -v mbpoll >/dev/null && command -v socat >/dev/null && command -v ip >/dev/null; then
    echo "mbpoll, socat and ip are there: $(command -v mbpoll socat ip | xargs)"
else
    as_root=()
    if [ "$(id -u)" -ne 0 ]; then
        as_root=(sudo)
    fi
    "${as_root[@]}" apt-get update -qq
    "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq mbpoll socat iproute2
fi

found=$("$venv/bin/python" -c "import pymodbus, serial; print(pymodbus.__version__, serial.__version__)" 2>/dev/null || true)
if [ "$found" = "$pymodbus $pyserial" ]; then
    echo "pymodbus $pymodbus and pyserial $pyserial are there: $venv"
else
    mkdir -p "$cache"
    python3 -m venv --clear "$venv"
    "$venv/bin/pip" install --quiet --disable-pip-version-check "pymodbus==$pymodbus" "pyserial==$pyserial"
    echo "pymodbus $pymodbus and pyserial $pyserial installed: $venv"
fi
