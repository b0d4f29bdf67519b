#!/usr/bin/env bash
# Fuzzes every decoder: what comes over a link or out of a file. Prints for each target how often it ran, what it covered (cov: edges,
# ft: features) and what it found; exit status 1 on a finding. Usage: run.sh [SECONDS] [TARGET...] (600 seconds, all targets)
#
# No sanitizer: the decoders have no unsafe code, and so stable Rust does. One process at a time, so that the machine stays usable.
# What the targets learn stays in target/fuzz/corpus, findings go to target/fuzz/findings; fuzz/corpus has the seeds.
set -euo pipefail
cd "$(dirname "$0")/.."
seconds=${1:-600}
shift || true
cache=${XDG_CACHE_HOME:-$HOME/.cache}/benderd-tests
PATH="$cache/bin:$PATH"
if ! command -v cargo-fuzz >/dev/null; then
    cargo install cargo-fuzz --locked --root "$cache"
fi
if [ $# -eq 0 ]; then
    mapfile -t targets < <(cargo fuzz list)
    set -- "${targets[@]}"
fi
host=$(rustc -vV | sed -n 's/^host: //p')
out=target/fuzz
cargo fuzz build --sanitizer none --target-dir "$out"

found=0
for target in "$@"; do
    corpus=$out/corpus/$target findings=$out/findings/$target log=$out/$target.log
    mkdir -p "$corpus" "$findings"
    seeds=("fuzz/corpus/$target")
    if [ "$target" = profile ]; then
        seeds+=(protocols) # the shipped ones
    fi
    status=0
    "$out/$host/release/$target" "$corpus" "${seeds[@]}" -max_total_time="$seconds" -timeout=10 -rss_limit_mb=2048 \
        -max_len=4096 -artifact_prefix="$findings/" -print_final_stats=1 >"$log" 2>&1 || status=$?
    runs=$(sed -nE 's/^stat::number_of_executed_units: *([0-9]+)/\1/p' "$log")
    covered=$(grep -oE 'cov: [0-9]+ ft: [0-9]+' "$log" | tail -n 1 || true)
    if [ "$status" -eq 0 ]; then
        echo "ok      $target: ${runs:-?} executions in $seconds s, ${covered:-nothing covered}, nothing found"
    else
        found=$((found + 1))
        echo "FAILED  $target: ${runs:-?} executions, ${covered:-nothing covered}, found:"
        grep -aE -A 3 'panicked at|ERROR: libFuzzer|Test unit written' "$log" || tail -n 20 "$log"
    fi
done
echo "$# targets, $found with findings"
[ "$found" -eq 0 ]
