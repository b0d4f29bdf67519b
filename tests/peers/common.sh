# What the scripts that let benderd deliver to a peer share; they set $binary and source this in their work folder.
# shellcheck shell=bash disable=SC2154,SC2034

# Tables of three bends: the program is "bracket".
cat >first.csv <<'CSV'
length_mm,rotation_deg,angle_deg,radius_mm
120.25,0,92.125,50.8
80.5,-60.5,181.25,50.8
6000,180,0.001,50.8
100.75,0,0,
CSV
sed -e 's/^120.25/33.33/' -e 's/92.125/93.5/' first.csv >second.csv
sed -e 's/181.25/185.001/' first.csv >wide.csv # the profiles take 190 degrees, machine.py 185

bender=

# start COMMAND...: a bender; its first line in $said, the rest in the file bender.log.
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
    echo "$said"
}

simulated() { # PROFILE ADDRESS
    start "$binary" simulate bender --profile "$1" --on "$2" --program bracket --bends 3
}

stop() {
    kill "$bender"
    wait "$bender" || true
    bender=
}

deliver() { # PROGRAM TABLE PROFILE ADDRESS
    "$binary" push "$2" --bender "$3" --on "$4" --program "$1" --journal journal.db
}

# push TABLE PROFILE ADDRESS: a delivery that must be applied.
push() {
    deliver bracket "$@" >pushed
    grep '^done' pushed
}

# refused WHY PROGRAM TABLE PROFILE ADDRESS: a delivery that must end with status 1 and say why.
refused() {
    local why=$1 status=0
    shift
    deliver "$@" >pushed 2>&1 || status=$?
    if [ "$status" -ne 1 ] || ! grep -q "$why" pushed; then
        echo "FAILED: status $status, expected 1 and \"$why\"; benderd said:"
        cat pushed
        exit 1
    fi
    echo "ok  refused: $(grep -m 1 "$why" pushed)"
}

# delivered PROFILE ADDRESS: two deliveries to a peer as the bender, the second stays in force over two that are refused.
delivered() {
    push first.csv "$@"
    push second.csv "$@"
    refused "the machine has \"bracket\" loaded" other first.csv "$@"
    refused "code 8" bracket wide.csv "$@"
}
