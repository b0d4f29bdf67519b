#!/usr/bin/env bash
# Independent peers on both sides, over TCP and a serial line (pseudo terminals). Clients: after `benderd push`, pymodbus
# and mbpoll read the simulated bender's active table by register address. Server: pymodbus is the bender, benderd
# delivers to it and is refused by it, mbpoll reads the table back. Usage: run.sh BINARY (after install.sh)
set -euo pipefail
export PYTHONDONTWRITEBYTECODE=1 # nothing of the clone's changes
binary=$(realpath "${1:?usage: run.sh BINARY}")
here=$(cd "$(dirname "$0")" && pwd)
python=${XDG_CACHE_HOME:-$HOME/.cache}/benderd-tests/pymodbus-3.16.1/bin/python
for needed in "$python" mbpoll socat; do
    if ! command -v "$needed" >/dev/null; then
        echo "$needed is missing: run $here/install.sh first"
        exit 1
    fi
done
work=$(mktemp -d)
line=
finish() {
    for pid in ${bender-} $line; do
        kill "$pid" 2>/dev/null || true
    done
    rm -rf "$work"
}
trap finish EXIT
cd "$work"
# shellcheck source=tests/peers/common.sh
source "$here/common.sh"

pymodbus() { # --port PORT | --serial PATH
    start "$python" "$here/modbus_bender.py" --program bracket --bends 3 "$@"
}

# The port in what a bender said.
port() {
    sed -nE 's/.* listens on ([0-9.]+):([0-9]+).*/\2/p' <<<"$said"
}

# polled NAME REVISION HOW...: mbpoll reads the active revision (register 24), then from register 2018 on the last
# length and length, rotation, angle of each bend of second.csv.
polled() {
    local name=$1 expected="$2 10075 3333 0 93500 8050 -60500 181250 600000 180000 1" found
    shift 2
    found=$(
        for registers in "-r 24 -c 1" "-r 2018 -c 10"; do
            # shellcheck disable=SC2086 # two options, two words each
            mbpoll -a 1 -0 -1 -q -B -t 4:int $registers "$@" | sed -nE 's/^\[[0-9]+\]:[[:space:]]+(-?[0-9]+).*/\1/p'
        done | xargs
    )
    if [ "$found" != "$expected" ]; then
        echo "FAILED mbpoll over $name: found $found, expected $expected"
        exit 1
    fi
    echo "ok  mbpoll over $name reads active revision and table: $found"
}

simulated reference-modbus 127.0.0.1:0
port=$(port)
push first.csv reference-modbus "127.0.0.1:$port"
"$python" "$here/modbus_peer.py" "$port" first.csv bracket 1
push second.csv reference-modbus "127.0.0.1:$port"
"$python" "$here/modbus_peer.py" "$port" second.csv bracket 2
polled TCP 2 -m tcp -p "$port" 127.0.0.1
stop

simulated reference-rtu "$work/line"
push second.csv reference-rtu "$work/line"
polled RTU 1 -m rtu -b 19200 -P even "$work/line"
stop

"$python" "$here/machine.py"
pymodbus --port 0
port=$(port)
delivered reference-modbus "127.0.0.1:$port"
polled "TCP to pymodbus" 2 -m tcp -p "$port" 127.0.0.1
"$python" "$here/modbus_peer.py" "$port" second.csv bracket 2
sed 1d bender.log
stop

socat pty,raw,echo=0,link="$work/ours" pty,raw,echo=0,link="$work/theirs" &
line=$!
until [ -e ours ] && [ -e theirs ]; do
    kill -0 "$line" || { echo "FAILED: socat made no pair of pseudo terminals"; exit 1; }
    sleep 0.05
done
pymodbus --serial "$work/theirs"
delivered reference-rtu "$work/ours"
polled "RTU to pymodbus" 2 -m rtu -b 19200 -P even "$work/ours"
sed 1d bender.log
stop

echo "peers: benderd's tables are found by pymodbus and mbpoll in the simulated bender, by mbpoll in pymodbus as the bender"
