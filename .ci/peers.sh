#!/bin/sh
# What `make bench-peers` does: brings the peers into a virtual environment of their own (about 5 GB), builds our program, and
# compares. Options for the comparison: make bench-peers PEERS="--rounds 3 --only DQN" (tests/peers/run.py --help).
set -eu
cd "$(dirname "$0")/.."
venv=${GADM_PEERS:-target/peers}
.ci/peers-install.sh
cargo build --release --locked -p gadm-trainer
exec "$venv/bin/python" tests/peers/run.py --gadm "${CARGO_TARGET_DIR:-target}/release/gadm" "$@"
