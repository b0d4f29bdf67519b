#!/usr/bin/env bash
# Writes docs/convergence.md: how soon tubes are in tolerance on simulated plants, beside what could be known at best.
#
#   bash benches/convergence.sh [JOBS] [CURVES.csv]
#
# JOBS per line, 1000 without. Three seeds. With a file of spring-back curves these are a third plant.
set -euo pipefail
cd "$(dirname "$0")/.."
jobs=${1:-1000}
curves=()
[ $# -ge 2 ] && curves=(--curves "$2")
cargo build --release --quiet --example convergence
out=docs/convergence.md
{
    cat <<TEXT
# Convergence

Written by \`bash benches/convergence.sh\` on $(date +%F): $jobs jobs per line, three seeds, six bends per part drawn at random.

- **A**: angles measured to 0.05 degrees, bends scatter by 0.08, a program's bends are off by 0.10 each, tubes of a batch do not
  scatter. **B**: the believable bender in full: tubes scatter by 1.5 %, bends by 0.05 degrees and 0.8 % of their spring-back, clamps
  slip now and then. **curves**: B with the spring-back curves of a finite-element study, each of a tube and die of its own.
- Shares are percent of *true* tubes: all angles within 0.3 or 0.5 degrees; all check points within 1 mm of where they should be, across
  the tube or in all directions, ends included but for the last one, which the cut decides. Lengths are the median of distances between
  corners, envelope the farthest check point, medians over the jobs.
- **benderd / oracle / deadbeat / half gain.** The oracle sees the same scans and knows the plant's laws and every covariance, only
  not what was drawn; of a batch that changes it knows that it may, once, at any tube alike, by 10 % (one sigma). On the curves it
  knows the very curve of the tube. Deadbeat corrects each value by its own error, half gain by half of it.
- *Called good*, *held falsely* and *scanned again* are benderd's verdicts: 1 mm on such tubes is about what a scan is uncertain by, so few
  are shown to be good.

TEXT
    for seed in 1000000 2000000 3000000; do
        target/release/examples/convergence --jobs "$jobs" --seed "$seed" "${curves[@]}"
        echo
    done
} > "$out.new"
mv "$out.new" "$out"
