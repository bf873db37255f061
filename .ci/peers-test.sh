#!/bin/sh
# What `make test-peers` does: one update of every baseline learner, ours against PyTorch's, on the same numbers. PyTorch comes into
# the virtual environment of `make bench-peers` (about 5 GB), or is taken from the one that GADM_PEERS names.
set -eu
cd "$(dirname "$0")/.."
venv=${GADM_PEERS:-target/peers}
"$venv/bin/python" -c "import torch" 2>/dev/null || .ci/peers-install.sh
exchange=$(mktemp)
trap 'rm -f "$exchange"' EXIT
cargo run --quiet --locked -p gadm-trainer --example learner_updates >"$exchange"
"$venv/bin/python" tests/peers/oracle.py <"$exchange"
