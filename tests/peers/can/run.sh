#!/usr/bin/env bash
# Runs inside.sh in user-mode Linux, a kernel with CAN as an ordinary process: this machine's own kernel needs none. The
# guest sees this machine's files, read only; it is killed when it is done, or after two minutes and eight seconds for each
# delivery. Where it does not come up, the reason is printed and nothing is tested.
# Usage: run.sh BINARY [COUNT] (after install.sh); so many deliveries go over vcan0 for each of its protocols, 5 unless said.
set -euo pipefail
binary=$(realpath "${1:?usage: run.sh BINARY}")
count=${2:-5}
here=$(cd "$(dirname "$0")" && pwd)
python=${XDG_CACHE_HOME:-$HOME/.cache}/benderd-tests/can-$(cksum <"$here/requirements.txt" | cut -d ' ' -f 1)/bin/python
began="CAN peers begin" ended="CAN peers end with status"

if ! command -v linux.uml >/dev/null; then
    case $(uname -sm) in
    "Linux x86_64" | "Linux i"?86)
        echo "linux.uml is missing: run $here/install.sh first"
        exit 1
        ;;
    esac
    echo "skipped: no user-mode Linux for $(uname -sm)"
    exit 0
fi
if [ ! -x "$python" ]; then
    echo "python-can, cantools and canopen are missing: run $here/install.sh first"
    exit 1
fi

work=$(mktemp -d)
guest=
finish() {
    if [ -n "$guest" ]; then
        kill -9 -- "-$guest" 2>/dev/null || true # all of it: processes left over would go on
    fi
    rm -rf "$work"
}
trap finish EXIT

# The guest's first process. The clone's and the binary's paths are the same in there.
cat >"$work/init" <<INIT
#!/bin/bash
export PATH=/usr/sbin:/usr/bin:/sbin:/bin HOME=/run LC_ALL=C PYTHONDONTWRITEBYTECODE=1
mount -t proc proc /proc
mount -t sysfs sysfs /sys
mount -t tmpfs tmpfs /run
echo "$began on kernel \$(uname -r)"
bash $(printf '%q ' "$here/inside.sh" "$binary" "$python" "$count")
echo "$ended \$?"
exec sleep 1000
INIT
chmod +x "$work/init"

begin=$SECONDS limit=$((120 + 8 * count))
setsid linux.uml mem=512M quiet uml_dir="$work/uml" rootfstype=hostfs rootflags=/ ro init="$work/init" \
    con=null con0=fd:0,fd:1 >"$work/console" 2>&1 </dev/null &
guest=$!
until grep -q "^$ended [0-9]" "$work/console" || ! kill -0 "$guest" 2>/dev/null || [ $((SECONDS - begin)) -ge "$limit" ]; do
    sleep 0.1
done
kill -9 -- "-$guest" 2>/dev/null || true
wait "$guest" 2>/dev/null || true
guest=

tr -d '\r' <"$work/console" >"$work/said"
if ! grep -q "^$began" "$work/said"; then
    cat "$work/said"
    echo "skipped: user-mode Linux does not come up here, its last words are above"
    exit 0
fi
sed -n "/^$began/,/^$ended/p" "$work/said"
if ! grep -q "^$ended" "$work/said"; then
    echo "FAILED: the guest hung or died, it was stopped after $((SECONDS - begin)) s; its last lines are above"
    exit 1
elif ! grep -qx "$ended 0" "$work/said"; then
    echo "FAILED: a check inside user-mode Linux failed, see above"
    exit 1
fi
echo "can peers: $(grep -c '^ok ' "$work/said") checks in user-mode Linux in $((SECONDS - begin)) s, $(grep -c '^skipped' "$work/said") skipped"
