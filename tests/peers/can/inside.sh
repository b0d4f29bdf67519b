#!/usr/bin/env bash
# What run.sh runs inside user-mode Linux: brings up vcan0 and puts independent peers on it, candump and cantools that
# read along, canopen as the bender. /run is the only place that can be written. Usage: inside.sh BINARY PYTHON COUNT
set -euo pipefail
binary=$1 python=$2 count=$3
here=$(cd "$(dirname "$0")" && pwd)
dbc=$here/../../../protocols/bender.dbc
mkdir /run/peers
cd /run/peers
# shellcheck source=tests/peers/common.sh
source "$here/../common.sh"

for module in net/can/can net/can/can-raw drivers/net/can/dev/can-dev drivers/net/can/vcan; do
    insmod "/usr/lib/uml/modules/$(uname -r)/kernel/$module.ko"
done
ip link set lo up
ip link add dev vcan0 type vcan
ip link set vcan0 up

# logged FILE COMMAND...: candump reads along while the command runs, and for some status cycles around it.
logged() {
    local log=$1 candump
    shift
    candump -L -r 4194304 vcan0 >"$log" & # with the usual buffer it loses frames after 278
    candump=$!
    sleep 0.5
    "$@"
    sleep 0.5
    kill "$candump"
    wait "$candump" || true
}

logged echo.log cansend vcan0 123#DEADBEEF
if ! grep -q ' vcan0 123#DEADBEEF$' echo.log; then
    echo "FAILED: candump does not see what cansend sent, vcan0 does not work: $(cat echo.log)"
    exit 1
fi
echo "ok  vcan0: candump sees what cansend sent"

canopen() {
    start "$python" "$here/canopen_bender.py" --program bracket --bends 3
}

canopen
"$python" "$here/canopen_peer.py" deliver first.csv bracket 1
stop
"$python" "$here/canopen_peer.py" compare bender.log first.csv bracket 1

simulated reference-can vcan0
logged first.log push first.csv reference-can vcan0
"$python" "$here/can_peer.py" "$dbc" first.log first.csv bracket 1
logged second.log push second.csv reference-can vcan0
"$python" "$here/can_peer.py" "$dbc" second.log second.csv bracket 2
stop

canopen
delivered reference-canopen vcan0
stop
sed 1d bender.log
"$python" "$here/canopen_peer.py" compare bender.log second.csv bracket 2

# Deliveries over the socket, with damaged answers and trouble at the machine.
deliveries=$(dirname "$binary")/examples/deliveries
if [ -x "$deliveries" ] && [ "$count" -gt 0 ]; then
    for profile in reference-can reference-canopen; do
        TMPDIR=/run "$deliveries" --profile "$profile" --real --on vcan0 --count "$count" --per-mille 4
        echo "ok  $count deliveries over $profile on vcan0"
    done
else
    echo "skipped: deliveries over vcan0: cargo build --release --examples"
fi
