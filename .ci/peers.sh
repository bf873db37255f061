#!/bin/sh
# What `make bench-peers` does: brings the peers into a virtual environment of their own (about 5 GB), builds our program, and
# compares. Options for the comparison: make bench-peers PEERS="--rounds 3 --only DQN" (tests/peers/run.py --help).
set -eu
cd "$(dirname "$0")/.."
venv=${GADM_PEERS:-target/peers}
needs=tests/peers/requirements.txt
if ! cmp -s "$needs" "$venv/installed.txt"; then
    echo "bringing PyTorch, gymnasium and envpool into $venv (about 5 GB)" >&2
    python3 -m venv "$venv" || { echo "python3 -m venv does not work here: apt install python3-venv" >&2; exit 1; }
    "$venv/bin/pip" install --quiet --no-cache-dir -r "$needs"
    cp "$needs" "$venv/installed.txt"
fi
cargo build --release --locked -p gadm-trainer
exec "$venv/bin/python" tests/peers/run.py --gadm "${CARGO_TARGET_DIR:-target}/release/gadm" "$@"
