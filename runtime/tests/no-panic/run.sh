#!/bin/sh
# Builds the library for TARGET (default thumbv7em-none-eabihf) and fails when a panic is reachable from what a device
# calls. A second build with a deliberate panic must be found, or the check itself is broken.
set -eu
cd "$(dirname "$0")"
target="${1:-thumbv7em-none-eabihf}"
out="${CARGO_TARGET_DIR:-$PWD/target}"
build() {
    cargo build --quiet --release --target "$target" --target-dir "$out" "$@"
    grep -c gadm_panic_is_reachable "$out/$target/release/libgadm_no_panic.a" || true
}
if [ "$(build --features control)" = 0 ]; then
    echo "no-panic: the check does not find a deliberate panic on $target" >&2
    exit 1
fi
if [ "$(build)" != 0 ]; then
    echo "no-panic: a panic is reachable from load, act or self_test on $target" >&2
    exit 1
fi
echo "no-panic: $target, no panic is reachable"
