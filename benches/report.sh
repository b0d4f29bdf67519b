#!/usr/bin/env bash
# Writes docs/benchmarks.md: times of every stage (cargo bench), processor time and peak memory of the program; instructions
# without and with the nominal; the tables of the accuracy example without and with it. `report.sh operations nominal`
# writes these sections anew and keeps the others. QUICK=1 takes the times that the last cargo bench left behind.
set -euo pipefail
cd "$(dirname "$0")/.."

sizes=(6005 100000 1000000 5000000)
stages=(read scene structure finish reconstruct "file to table")
seeds=(${SEEDS:-107000 108000 109000})
release=${CARGO_TARGET_DIR:-target}/release

sections=(times operations accuracy nominal)
wanted=("$@")
[ $# -gt 0 ] || wanted=("${sections[@]}")

cargo build --release --bin benderd --example accuracy >&2

# Milliseconds, or a bound of the median's 95 % interval, from what criterion wrote.
field() { sed -E "s/.*\"median\":\\{\"confidence_interval\":\\{([^}]*)\\},\"point_estimate\":([^,]+).*/\\$2/" "$1"; }
estimates() { printf 'target/criterion/reconstruct/%s/%s/new/estimates.json' "$1" "$2"; }
round() { awk '{ printf ($1 < 10e6 ? "%.1f" : "%.0f"), $1 / 1e6 }'; }
median() { field "$(estimates "$1" "$2")" 2 | round; }
half_width() {
    field "$(estimates "$1" "$2")" 1 | sed -E 's/.*"lower_bound":([^,]+),"upper_bound":(.+)/\1 \2/' |
        awk '{ print ($2 - $1) / 2 }' | round
}

# Median of user and system time and the peak memory over the file's size, of five runs.
program() {
    for _ in 1 2 3 4 5; do
        /usr/bin/time -f '%U %S %M' "$release/benderd" reconstruct "target/bench/$1.ply" 2>&1 >/dev/null | tail -1
    done | awk '{ print $1 + $2, $3 }' | sort -n | awk -v bytes="$(stat -c %s "target/bench/$1.ply")" '
        { cpu[NR] = $1; if ($2 > peak) peak = $2 }
        END { printf "| %.2f s | %.1f MB | %.1f MB (%.1f x) |", cpu[int(NR / 2) + 1], bytes / 1e6,
              peak * 1.024e-3, peak * 1024 / bytes }'
}

# Tables of a set, one per first seed; the exit status only says whether the targets were met.
accuracy() {
    for seed in "${seeds[@]}"; do
        printf '\n`accuracy -- %s --seed %s`:\n\n' "$*" "$seed"
        "$release/examples/accuracy" "$@" --seed "$seed" --markdown || true
    done
}

# When and where a section was written.
written() {
    cat <<TEXT
Written by \`bash benches/report.sh\` on $(date -u +%Y-%m-%d): $(nproc) cores of
$(sed -n 's/^model name[^:]*: //p' /proc/cpuinfo | head -1), load average $(cut -d' ' -f1-3 /proc/loadavg).
TEXT
}

times() {
    [ -n "${QUICK:-}" ] || cargo bench --bench reconstruct >&2
    cat <<TEXT
# Benchmarks

$(written)

Times are medians with half their 95 % interval, which is the machine's noise during the run: where it is wide the
processor time below says more. The scans are simulated (bracket-17, 4 bends, one pass, 0.03 mm noise, binary PLY).

| points | ${stages[0]} | ${stages[1]} | ${stages[2]} | ${stages[3]} | ${stages[4]} | ${stages[5]} |
| --- | --- | --- | --- | --- | --- | --- |
TEXT
    for n in "${sizes[@]}"; do
        printf '| %s |' "$n"
        for stage in "${stages[@]}"; do
            printf ' %s ±%s ms |' "$(median "$stage" "$n")" "$(half_width "$stage" "$n")"
        done
        printf '\n'
    done
    cat <<TEXT

\`read\`: file to cloud, with its hash; \`scene\`: the tube among what lies around it; \`structure\`: how many bends, on a
thinned cloud; \`finish\`: fit to all points, ends, sigmas; \`reconstruct\`: these three; \`file to table\`: all.

The whole program (\`/usr/bin/time\`, five runs: median processor time, largest peak of memory):

| points | processor time | file | peak memory |
| --- | --- | --- | --- |
TEXT
    for n in "${sizes[@]}"; do printf '| %s %s\n' "$n" "$(program "$n")"; done
    cat <<TEXT

For comparison, on like clouds: the method's paper took 50 s for 6005 points (2 GHz PC, 5 bends). General shape detectors
(CGAL's efficient RANSAC, PCL) take 0.5 s of processor time at 6 k points, 4 s at 100 k and 38 s at 1 M, find 3 of 5, 6
of 8 and 10 of 12 bends beside false shapes, and give no LRA.
TEXT
}

operations() {
    printf '# Operations\n\n%s\n\n' "$(written)"
    bash benches/operations.sh
}

right() {
    cat <<TEXT
# Accuracy

Three seeds each that nothing was tuned on: what the tables count is in \`src/trial/accuracy\`.
$(accuracy thirty --count "${THIRTY:-270}")
$(accuracy hard --count "${HARD:-270}")
$(accuracy flattened --count "${FLATTENED:-100}")
TEXT
}

nominal() {
    local seeds=("${seeds[0]}")
    cat <<TEXT
# Accuracy with the nominal

$(written)

The nominal is the part as drawn before the tube sprang back (1 to 4 %, and angles up to 0.3 degrees, rotations 0.2 degrees,
lengths 0.5 mm off), from either end. Then each tube is measured with wrong nominals.
$(accuracy thirty --nominal --count "${GUIDED:-100}")
$(accuracy hard --nominal --count "${GUIDED:-100}")
TEXT
}

# A section as it stands in the report.
kept() { awk -v h="# $1" '/^# / { on = $0 == h } on' docs/benchmarks.md; }

# A section, and an empty line: anew when it is wanted and the machine has what it takes, else as it stands.
section() {
    if [[ " ${wanted[*]} " == *" $1 "* ]] && { [ "$1" != operations ] || command -v valgrind >/dev/null; }; then
        "$2"
    else
        kept "$3"
    fi
    echo
}

# Empty lines are never doubled and none is the last.
{
    section times times "Benchmarks"
    section operations operations "Operations"
    section accuracy right "Accuracy"
    section nominal nominal "Accuracy with the nominal"
} | cat -s | sed -e '${/^$/d}' >target/benchmarks.md
mv target/benchmarks.md docs/benchmarks.md
