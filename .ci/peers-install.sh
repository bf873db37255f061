#!/bin/sh
# Brings the programs of tests/peers/requirements.txt into a virtual environment of their own, once for each state of that file.
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
