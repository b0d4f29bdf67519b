#!/usr/bin/env bash
# Installs what tests/peers/run.sh needs and this machine lacks: mbpoll (apt), pymodbus (pip, pinned, in a virtual
# environment outside the clone). Does nothing when all is there.
set -euo pipefail
pymodbus=3.16.1
cache=${XDG_CACHE_HOME:-$HOME/.cache}/benderd-tests
venv=$cache/pymodbus-$pymodbus

if command -v mbpoll >/dev/null; then
    echo "mbpoll is there: $(command -v mbpoll)"
else
    as_root=()
    if [ "$(id -u)" -ne 0 ]; then
        as_root=(sudo)
    fi
    "${as_root[@]}" apt-get update -qq
    "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq mbpoll
fi

if [ -x "$venv/bin/python" ] && "$venv/bin/python" -c "import pymodbus; assert pymodbus.__version__ == '$pymodbus'" 2>/dev/null; then
    echo "pymodbus $pymodbus is there: $venv"
else
    mkdir -p "$cache"
    python3 -m venv --clear "$venv"
    "$venv/bin/pip" install --quiet --disable-pip-version-check "pymodbus==$pymodbus"
    echo "pymodbus $pymodbus installed: $venv"
fi
