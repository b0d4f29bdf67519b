#!/usr/bin/env bash
# Prints how many instructions a reconstruction takes without and with the nominal: of the whole program, and of the search
# for the structure alone. They are counted by valgrind, so that neither load nor clock shows. A section of report.sh.
# POINTS="6000 100000" and BENDS="3 9" choose among the scans.
set -euo pipefail
cd "$(dirname "$0")/.."

folder=${CARGO_TARGET_DIR:-target}/operations
release=${CARGO_TARGET_DIR:-target}/release
command -v valgrind >/dev/null || { echo "operations: no valgrind here" >&2; exit 3; }
cargo build --release --bin benderd --example operations >&2
"$release/examples/operations" scans "$folder"

# Millions of instructions of a command; one thread, since waiting for work is none.
count() {
    RAYON_NUM_THREADS=1 valgrind --tool=callgrind --callgrind-out-file=/dev/null "$@" 2>&1 >/dev/null |
        awk '/Collected/ { printf "%.1f", $NF / 1e6 }'
}
upto() { count "$release/examples/operations" until "$@"; }

cat <<TEXT
Millions of instructions (\`valgrind\`, one thread) of \`benderd reconstruct\` on a scan of a simulated tube, alone and with its
nominal (\`--nominal\`, the part as drawn before spring-back); and of the search for its structure alone.

| bends | points | program, free | with nominal | times fewer | search, free | with nominal | times fewer |
|--:|--:|--:|--:|--:|--:|--:|--:|
TEXT
for bends in ${BENDS:-3 5 9 14}; do
    for points in ${POINTS:-6000 100000 1000000}; do
        scan=$folder/$bends-$points.ply
        for nominal in "" "--nominal $folder/$bends.toml"; do
            # shellcheck disable=SC2086 # no nominal is no word
            echo "$(count "$release/benderd" reconstruct "$scan" $nominal)" \
                "$(upto fit "$scan" $nominal) $(upto structure "$scan" $nominal)"
        done | awk -v bends="$bends" -v points="$points" '
            { whole[NR] = $1; search[NR] = $2 - $3 }
            END { printf "| %d | %d | %.0f | %.0f | %.1f | %.0f | %.0f | %.1f |\n", bends, points, whole[1], whole[2],
                  whole[1] / whole[2], search[1], search[2], search[1] / search[2] }'
    done
done
