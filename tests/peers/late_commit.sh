#!/usr/bin/env bash
# A network that is down from just before the commit until after benderd has given it up: nothing may arrive when it is back. The
# machine is in a network namespace of its own; its address at the link layer is made wrong for a while, one way only.
# Usage: late_commit.sh BINARY (skipped, with the reason, where namespaces cannot be had)
set -euo pipefail
binary=$(realpath "${1:?usage: late_commit.sh BINARY}")
here=$(cd "$(dirname "$0")" && pwd)
if [ "${2:-}" != inside ]; then
    for needed in ip unshare; do
        if ! command -v "$needed" >/dev/null; then
            echo "late commit: skipped: there is no $needed here"
            exit 0
        fi
    done
    if ! why=$(unshare -rnm true 2>&1); then
        echo "late commit: skipped: no namespaces here ($why)"
        exit 0
    fi
    exec unshare -rnm bash "$0" "$binary" inside
fi

work=$(mktemp -d)
trap 'kill ${bender-} 2>/dev/null || true; rm -rf "$work"' EXIT
cd "$work"
. "$here/common.sh"
mount -t tmpfs none /run
ip netns add machine
ip link set lo up
ip link add ours type veth peer name theirs netns machine
ip addr add 10.9.0.1/24 dev ours
ip link set ours up
ip -n machine addr add 10.9.0.2/24 dev theirs
ip -n machine link set theirs up

# The fifth answer, the last look before the commit, comes late: time to cut the way there. The one before it does, too, so that the
# heart has beaten meanwhile and one look is enough.
cat >late.toml <<'TOML'
version = 1
[[event]]
at_answer = 4
what = "late"
late_ms = 100
[[event]]
at_answer = 5
what = "late"
late_ms = 700
TOML
start ip netns exec machine "$binary" simulate bender --profile reference-modbus --on 10.9.0.2:5020 \
    --program bracket --bends 3 --script late.toml
hardware=$(ip netns exec machine cat /sys/class/net/theirs/address)
deliver bracket first.csv reference-modbus 10.9.0.2:5020 >pushed 2>&1 &
push=$!
until grep -q '700 ms late' bender.log; do
    kill -0 "$push" || { echo "FAILED: the delivery ended before it could be cut:"; cat pushed; exit 1; }
    sleep 0.01
done
ip neigh replace 10.9.0.2 lladdr 02:00:00:00:00:77 dev ours nud permanent
status=0
wait "$push" || status=$?
ip neigh replace 10.9.0.2 lladdr "$hardware" dev ours nud permanent
if [ "$status" -ne 3 ] || ! grep -q 'was committed' pushed; then
    echo "FAILED: status $status where 3, outcome unknown, was expected; benderd said:"
    cat pushed
    exit 1
fi
# The system tries again after twice the time that it has tried already: a commit that was not dropped is there by then.
deadline=$((SECONDS + 12))
while [ "$SECONDS" -lt "$deadline" ]; do
    if grep -q 'took over\|taken over\|revision 1' bender.log; then
        echo "FAILED: a commit that had been given up arrived later; the machine said:"
        cat bender.log
        exit 1
    fi
    sleep 0.2
done
echo "late commit: a commit given up while the network was down does not arrive when it is back"
