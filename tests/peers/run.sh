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
bender=
line=
finish() {
    for pid in $bender $line; do
        kill "$pid" 2>/dev/null || true
    done
    rm -rf "$work"
}
trap finish EXIT
cd "$work"

# start COMMAND...: a bender; its first line in $said, the port in it, if any, in $port, the rest in the file bender.log.
start() {
    : >bender.log
    "$@" >bender.log &
    bender=$!
    local deadline=$((SECONDS + 20))
    until grep -q listens bender.log; do
        if [ "$SECONDS" -ge "$deadline" ] || ! kill -0 "$bender" 2>/dev/null; then
            echo "FAILED: did not come up: $*"
            exit 1
        fi
        sleep 0.05
    done
    said=$(head -n 1 bender.log)
    port=$(sed -nE 's/.* listens on [0-9.]+:([0-9]+).*/\1/p' <<<"$said")
    echo "$said"
}

simulated() { # PROFILE ADDRESS
    start "$binary" simulate bender --profile "$1" --on "$2" --program bracket --bends 3
}

pymodbus() { # --port PORT | --serial PATH
    start "$python" "$here/modbus_bender.py" --program bracket --bends 3 "$@"
}

stop() {
    kill "$bender"
    wait "$bender" || true
    bender=
}

# push TABLE PROFILE ADDRESS [OPTION...]: a delivery that must be applied.
push() {
    push_for bracket "$@" >pushed
    grep '^done' pushed
}

push_for() { # PROGRAM TABLE PROFILE ADDRESS
    "$binary" push "$2" --bender "$3" --on "$4" --program "$1" --journal journal.db
}

# refused WHY PROGRAM TABLE PROFILE ADDRESS: a delivery that must end with status 1 and say why.
refused() {
    local why=$1 status=0
    shift
    push_for "$@" >pushed 2>&1 || status=$?
    if [ "$status" -ne 1 ] || ! grep -q "$why" pushed; then
        echo "FAILED: status $status, expected 1 and \"$why\"; benderd said:"
        cat pushed
        exit 1
    fi
    echo "ok  refused: $(grep -m 1 "$why" pushed)"
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

cat >first.csv <<'CSV'
length_mm,rotation_deg,angle_deg,radius_mm
120.25,0,92.125,50.8
80.5,-60.5,181.25,50.8
6000,180,0.001,50.8
100.75,0,0,
CSV
sed -e 's/^120.25/33.33/' -e 's/92.125/93.5/' first.csv >second.csv
sed -e 's/181.25/185.001/' first.csv >wide.csv # the profile takes 190 degrees, machine.py 185

simulated reference-modbus 127.0.0.1:0
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

# delivered NAME PROFILE ADDRESS HOW...: to pymodbus as the bender.
delivered() {
    local name=$1
    push first.csv "$2" "$3"
    push second.csv "$2" "$3"
    refused "the machine has \"bracket\" loaded" other first.csv "$2" "$3"
    refused "code 8" bracket wide.csv "$2" "$3"
    shift 3
    polled "$name to pymodbus" 2 "$@"
    sed 1d bender.log
}

"$python" "$here/machine.py"
pymodbus --port 0
delivered TCP reference-modbus "127.0.0.1:$port" -m tcp -p "$port" 127.0.0.1
"$python" "$here/modbus_peer.py" "$port" second.csv bracket 2
stop

socat pty,raw,echo=0,link="$work/ours" pty,raw,echo=0,link="$work/theirs" &
line=$!
until [ -e ours ] && [ -e theirs ]; do
    kill -0 "$line" || { echo "FAILED: socat made no pair of pseudo terminals"; exit 1; }
    sleep 0.05
done
pymodbus --serial "$work/theirs"
delivered RTU reference-rtu "$work/ours" -m rtu -b 19200 -P even "$work/ours"
stop

echo "peers: benderd's tables are found by pymodbus and mbpoll in the simulated bender, by mbpoll in pymodbus as the bender"
