#!/usr/bin/env bash
# Installs what tests/peers/can/run.sh needs and this machine lacks: user-mode Linux and can-utils (apt), python-can,
# cantools and canopen (pip, pinned, in a virtual environment outside the clone). Does nothing when all is there, or
# when there is no user-mode Linux for this machine.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
venv=${XDG_CACHE_HOME:-$HOME/.cache}/benderd-tests/can-$(cksum <"$here/requirements.txt" | cut -d ' ' -f 1)

PATH=$PATH:/usr/sbin:/sbin
lacking=
for needed in linux.uml candump ip insmod; do
    command -v "$needed" >/dev/null || lacking+=" $needed"
done
if [ -n "$lacking" ]; then
    echo "this machine lacks$lacking"
    case "$(uname -sm) $(command -v apt-get)" in
    "Linux x86_64 /"* | "Linux i"?"86 /"*) ;;
    *)
        echo "skipped: user-mode Linux comes from Debian, for x86_64 and i686; this is $(uname -sm)"
        exit 0
        ;;
    esac
    as_root=()
    if [ "$(id -u)" -ne 0 ]; then
        as_root=(sudo)
    fi
    "${as_root[@]}" apt-get update -qq
    "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive \
        apt-get install -y -qq --no-install-recommends user-mode-linux can-utils iproute2 kmod
fi
echo "user-mode Linux and can-utils are there: $(command -v linux.uml candump | xargs)"

if "$venv/bin/python" -c "import can, cantools, canopen" 2>/dev/null; then
    echo "python-can, cantools and canopen are there: $venv"
else
    mkdir -p "$(dirname "$venv")"
    python3 -m venv --clear "$venv"
    "$venv/bin/pip" install --quiet --disable-pip-version-check -r "$here/requirements.txt"
    echo "python-can, cantools and canopen installed: $venv"
fi
