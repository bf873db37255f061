#!/bin/sh
# Builds the C library for TARGET (default thumbv7em-none-eabihf) and fails when a panic is reachable in it. A second build
# with a deliberate panic must be found, or the check itself is broken.
set -eu
cd "$(dirname "$0")/.."
target="${1:-thumbv7em-none-eabihf}"
out="${CARGO_TARGET_DIR:-$PWD/target}/no-panic"
build() {
    cargo build --quiet --release --locked --target "$target" --target-dir "$out" --features "$1"
    grep -c gadm_panic_is_reachable "$out/$target/release/libgadm.a" || true
}
if [ "$(build prove,control)" = 0 ]; then
    echo "c-api: the check does not find a deliberate panic on $target" >&2
    exit 1
fi
if [ "$(build prove)" != 0 ]; then
    echo "c-api: a panic is reachable in the C library on $target" >&2
    exit 1
fi
if [ "$(build prove,trust-exporter)" != 0 ]; then
    echo "c-api: a panic is reachable in the C library with feature trust-exporter on $target" >&2
    exit 1
fi
echo "c-api: $target, no panic is reachable"
