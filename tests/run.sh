#!/usr/bin/env bash
# Runs everything that this project is tested by, part after part, from a fresh clone; stops at the first part that
# fails. What the tests need and the machine lacks is installed, or named with the reason why its part is skipped.
# FULL=1 adds the long runs: dependency policy, many property cases, fuzzing (a minute each decoder; fuzz/run.sh alone
# takes ten), campaigns of demos and deliveries, thirty tubes.
set -euo pipefail
cd "$(dirname "$0")/.."

export INSTA_UPDATE=no # a snapshot that changed is a failure here, not a new truth
cache=${XDG_CACHE_HOME:-$HOME/.cache}/benderd-tests
logs=$(mktemp -d)
trap 'rm -rf "$logs"' EXIT
summary=()

# part NAME COMMAND...: runs it, keeps its last line for the summary. Bash ignores -e inside: the parts below chain
# their commands by && or return by hand.
part() {
    local name=$1 begin=$SECONDS status=0
    shift
    printf '\n== %s: %s\n' "$name" "$*"
    "$@" 2>&1 | tee "$logs/part" || status=$?
    local last
    last=$(grep -v '^[[:space:]]*$' "$logs/part" | tail -n 1 || true)
    if [ "$status" -ne 0 ]; then
        summary+=("FAILED  $name ($((SECONDS - begin)) s): $last")
        report 1
    fi
    summary+=("ok      $name ($((SECONDS - begin)) s): $last")
}

report() {
    printf '\n== summary\n'
    printf '%s\n' "${summary[@]}"
    if [ "$1" -eq 0 ]; then
        printf 'all parts passed in %d s\n' "$SECONDS"
    fi
    exit "$1"
}

tools() {
    command -v cargo >/dev/null || { echo "cargo is missing: install Rust from https://rustup.rs"; return 1; }
    cargo fmt --version 2>/dev/null || rustup component add rustfmt || return 1
    cargo clippy --version 2>/dev/null || rustup component add clippy || return 1
    rustc --version
}

unit_tests() {
    cargo test --locked 2>&1 | tee "$logs/tests" || return 1
    awk '/^test result:/ { passed += $4; failed += $6; skipped += $8 }
         END { printf "%d tests passed, %d failed, %d ignored\n", passed, failed, skipped }' "$logs/tests"
}

# The daemon's own loop against the simulators: it must reach tolerance by itself and leave nothing behind.
demo() {
    target/release/benderd demo
}

deny() {
    if ! command -v cargo-deny >/dev/null && [ ! -x "$cache/bin/cargo-deny" ]; then
        cargo install cargo-deny --locked --root "$cache" || return 1
    fi
    local PATH="$cache/bin:$PATH"
    cargo deny check licenses bans sources || return 1
    # The advisory database is a git repository of its own, which not every builder reaches.
    if cargo deny fetch db; then
        cargo deny check advisories
    else
        echo "advisories skipped: their database cannot be reached from here"
    fi
}

demo_campaign() {
    local seed failed=0
    for seed in $(seq 1 20); do
        target/release/benderd demo --seed "$seed" | tail -n 1 || failed=$((failed + 1))
    done
    echo "20 seeds of the demo, $failed out of tolerance at the end"
    [ "$failed" -eq 0 ]
}

# Over each link in memory, then over its own terminal, socket or folder; CAN's are among its peers. A link that answers often
# gets less damage, so that some of its deliveries succeed.
deliveries() {
    local link
    for link in reference-modbus reference-rtu reference-rtu-over-tcp reference-serial reference-folder; do
        target/release/examples/deliveries --profile "$link" --count 10000 || return 1
        target/release/examples/deliveries --profile "$link" --real --count 200 --per-mille 50 || return 1
    done
    target/release/examples/deliveries --profile reference-can --count 10000 --per-mille 4 || return 1
    target/release/examples/deliveries --profile reference-canopen --count 10000 --per-mille 10
}

# They are a crate of their own: nothing else notices when they fall behind.
fuzz_targets() {
    cargo fmt --check --manifest-path fuzz/Cargo.toml &&
        cargo check --locked --manifest-path fuzz/Cargo.toml --target-dir target/fuzz-check
}

part tools tools
part format cargo fmt --check
part clippy cargo clippy --locked --all-targets
part tests unit_tests
part "fuzz targets" fuzz_targets
part release cargo build --locked --release --bins --example deliveries
part demo demo
part "peers: install" bash tests/peers/install.sh
part peers bash tests/peers/run.sh target/release/benderd
part "an outside shop" python3 -B tests/peers/shop.py target/release/benderd config/parts/bracket-17.toml
part "late commit" bash tests/peers/late_commit.sh target/release/benderd
part "can peers: install" bash tests/peers/can/install.sh
part "can peers" bash tests/peers/can/run.sh target/release/benderd
if [ "${FULL:-0}" = 1 ]; then
    part deny deny
    part "many property cases" env PROPTEST_CASES=2000 cargo test --locked
    part fuzzing bash fuzz/run.sh 60
    part "demo campaign" demo_campaign
    part "ten thousand deliveries" deliveries
    part "thirty tubes" cargo run --locked --release --example accuracy -- thirty
fi
report 0
