#!/bin/sh
# Builds the firmware into <project>/target/firmware/BOARD.elf and prints its size. A program from which a panic can be
# reached does not link.
#
# Usage: firmware-sim/firmware/build.sh [--check] [BOARD ...]      default: all boards
#
# --check also sees that the link-time proof works (a program with a deliberate panic must not link) and builds what only
# the tests use: BOARD-hang.elf, whose watchdog must act, and BOARD-vectors.elf, which compares a policy with the host.
set -eu

root=$(cd "$(dirname "$0")/../.." && pwd -P)
cd "$root/firmware-sim/firmware"
target=thumbv7em-none-eabihf
out=$root/target/firmware
built=${CARGO_TARGET_DIR:-$out/build}
mkdir -p "$out"

check=
if [ "${1-}" = --check ]; then
    check=1
    shift
fi
[ $# -gt 0 ] || set -- mps2-an386 mps2-an500 netduinoplus2

# build FEATURES PROGRAM NAME
build() {
    cargo build --quiet --locked --release --target "$target" --target-dir "$built" --features "$1" --bin "$2" || return 1
    cp "$built/$target/release/$2" "$out/$3.elf.tmp"
    mv "$out/$3.elf.tmp" "$out/$3.elf"
}

for board in "$@"; do
    build "$board" gadm-firmware "$board"
    echo "ok: firmware $board: no panic is reachable, $(wc -c <"$out/$board.elf") bytes of ELF with debug lines"
done
[ -n "$check" ] || exit 0

log=$(mktemp)
trap 'rm -f "$log"' EXIT
if build mps2-an386,control gadm-firmware control 2>"$log" || ! grep -q gadm_panic_is_reachable "$log"; then
    cat "$log" >&2
    echo "FAILED: firmware: a deliberate panic links, so the proof that none is reachable proves nothing" >&2
    exit 1
fi
echo "ok: firmware: a deliberate panic does not link"
build mps2-an386,hang gadm-firmware mps2-an386-hang
for board in mps2-an386 mps2-an500; do
    build "$board" vectors "$board-vectors"
done
