#!/usr/bin/env bash
# Independent peers against the simulated bender: after `benderd push`, pymodbus and mbpoll read its active table by
# register address and find the values; over a serial line (a pseudo terminal), mbpoll does. Usage: run.sh BINARY (after install.sh)
set -euo pipefail
binary=$(realpath "${1:?usage: run.sh BINARY}")
here=$(cd "$(dirname "$0")" && pwd)
python=${XDG_CACHE_HOME:-$HOME/.cache}/benderd-tests/pymodbus-3.16.1/bin/python
if [ ! -x "$python" ] || ! command -v mbpoll >/dev/null; then
    echo "pymodbus or mbpoll is missing: run $here/install.sh first"
    exit 1
fi
work=$(mktemp -d)
bender=
finish() {
    if [ -n "$bender" ]; then
        kill "$bender" 2>/dev/null || true
    fi
    rm -rf "$work"
}
trap finish EXIT
cd "$work"

# start PROFILE ADDRESS: a simulated bender; its first line in $line.
start() {
    mkfifo "said-$1"
    "$binary" simulate bender --profile "$1" --on "$2" --program bracket --bends 3 >"said-$1" &
    bender=$!
    exec 3<"said-$1"
    if ! read -r -t 20 line <&3; then
        echo "FAILED: the simulated bender did not come up"
        exit 1
    fi
    echo "$line"
}

stop() {
    kill "$bender"
    wait "$bender"
    bender=
}

start reference-modbus 127.0.0.1:0
port=$(sed -E 's/.* listens on [0-9.]+:([0-9]+);.*/\1/' <<<"$line")

# push TABLE PROFILE ADDRESS
push() {
    "$binary" push "$1" --bender "$2" --on "$3" --program bracket --journal journal.db >pushed
    grep '^done' pushed
}

cat >first.csv <<'CSV'
length_mm,rotation_deg,angle_deg,radius_mm
120.25,0,92.125,50.8
80.5,-60.5,181.25,50.8
6000,180,0.001,50.8
100.75,0,0,
CSV
sed -e 's/^120.25/33.33/' -e 's/92.125/93.5/' first.csv >second.csv

push first.csv reference-modbus "127.0.0.1:$port"
"$python" "$here/modbus_peer.py" "$port" first.csv bracket 1
push second.csv reference-modbus "127.0.0.1:$port"
"$python" "$here/modbus_peer.py" "$port" second.csv bracket 2

# polled NAME HOW...: mbpoll reads last length, then length, rotation, angle of each bend, from register 2018 on.
polled() {
    local name=$1 found expected="10075 3333 0 93500 8050 -60500 181250 600000 180000 1"
    shift
    found=$(mbpoll -a 1 -0 -1 -q -B -t 4:int -r 2018 -c 10 "$@" |
        sed -nE 's/^\[[0-9]+\]:[[:space:]]+(-?[0-9]+).*/\1/p' | xargs)
    if [ "$found" != "$expected" ]; then
        echo "FAILED mbpoll over $name: found $found, expected $expected"
        exit 1
    fi
    echo "ok  mbpoll over $name reads from register 2018: $found"
}

polled TCP -m tcp -p "$port" 127.0.0.1
stop

start reference-rtu "$work/line"
push second.csv reference-rtu "$work/line"
polled RTU -m rtu -b 19200 -P even "$work/line"
stop

echo "peers: pymodbus and mbpoll find the pushed tables in the simulated bender's active area"
