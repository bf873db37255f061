#!/bin/sh
# Brings or checks everything that `make demo` and `make test` need. A missing prerequisite gives one line with the fix
# and exit 4. Safe to run again: with everything in place it only looks, and needs no network.
set -eu

TARGETS="thumbv7em-none-eabihf thumbv7m-none-eabi thumbv8m.main-none-eabihf riscv32imac-unknown-none-elf"
COMPONENTS="rustfmt clippy"

fail() {
    echo "setup: $1" >&2
    exit 4
}

root=$(cd "$(dirname "$0")/.." && pwd -P)
cd "$root"

cc=${GADM_CC:-cc}
command -v "$cc" >/dev/null 2>&1 ||
    fail "no C compiler ($cc), which links the programs; install it (Debian: apt-get install build-essential) and run \`make setup\` again"
command -v cargo >/dev/null 2>&1 ||
    fail "cargo not found; install Rust from https://rustup.rs, open a new shell and run \`make setup\` again"

# The script says itself what is wrong with python3 or pip.
.ci/mujoco.sh

pinned=$(sed -n 's/^channel *= *"\(.*\)"/\1/p' rust-toolchain.toml)
toolchain=${RUSTUP_TOOLCHAIN:-$pinned}
if command -v rustup >/dev/null 2>&1; then
    missing=
    if rustup toolchain list | grep -q "^$toolchain[-. ]\|^$toolchain\$"; then
        have_targets=$(rustup target list --installed --toolchain "$toolchain")
        have_components=$(rustup component list --installed --toolchain "$toolchain")
        for target in $TARGETS; do
            echo "$have_targets" | grep -qx "$target" || missing="$missing $target"
        done
        for component in $COMPONENTS; do
            echo "$have_components" | grep -q "^$component\(-\|\$\)" || missing="$missing $component"
        done
    else
        missing=" the toolchain itself"
    fi
    if [ -n "$missing" ]; then
        echo "setup: Rust $toolchain lacks:$missing; installing" >&2
        log=$(mktemp)
        # shellcheck disable=SC2086 # lists of plain words
        rustup toolchain install "$toolchain" --profile minimal --no-self-update \
            $(printf -- '--component %s ' $COMPONENTS) $(printf -- '--target %s ' $TARGETS) >"$log" 2>&1 || {
            reason=$(grep -v '^[[:space:]]*$' "$log" | tail -n 1)
            rm -f "$log"
            fail "rustup could not install Rust $toolchain (${reason:-no message}); check the network and run \`make setup\` again"
        }
        rm -f "$log"
    fi
else
    # A Rust of another origin: it must be new enough, and `make test` needs the targets, which cargo then asks for.
    found=$(rustc --version | cut -d ' ' -f 2)
    oldest=$(printf '%s\n%s\n' "$pinned" "${found%%-*}" | sort -V | head -n 1)
    [ "$oldest" = "$pinned" ] ||
        fail "rustc $found is older than $pinned; install Rust from https://rustup.rs and run \`make setup\` again"
fi
