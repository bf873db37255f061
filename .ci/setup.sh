#!/bin/sh
# Brings or checks everything that `make demo` and `make test` need. A missing prerequisite gives one line with the fix
# and exit 4; without the emulators, the kernel and the C compiler of the Cortex-M and SocketCAN tests everything else
# works, so they give one line and no failure. Safe to run again: with everything in place it only looks, and needs no network.
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

for tool in "${CXX:-c++}" make; do
    command -v "$tool" >/dev/null 2>&1 ||
        fail "no $tool, which builds Box2D; install it (Debian: apt-get install build-essential) and run \`make setup\` again"
done

# The scripts say themselves what is wrong with python3 or pip.
.ci/mujoco.sh
.ci/cmake.sh
.ci/python.sh

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

# The Cortex-M tests run in an emulator, and one of them compiles C; the SocketCAN tests boot Debian's kernel in another
# where this machine's has no CAN. `make test` names them as not run without these.
packages=
command -v qemu-system-arm >/dev/null 2>&1 || packages="qemu-system-arm"
command -v arm-none-eabi-gcc >/dev/null 2>&1 ||
    packages="${packages:+$packages }gcc-arm-none-eabi libnewlib-arm-none-eabi"
if [ "$(uname -m)" = x86_64 ]; then
    command -v qemu-system-x86_64 >/dev/null 2>&1 || packages="${packages:+$packages }qemu-system-x86"
    command -v candump >/dev/null 2>&1 || packages="${packages:+$packages }can-utils"
    command -v busybox >/dev/null 2>&1 || packages="${packages:+$packages }busybox-static"
fi
if [ -n "$packages" ]; then
    without="the Cortex-M or SocketCAN tests that need it will not run"
    if ! command -v apt-get >/dev/null 2>&1; then
        echo "setup: not installed: $packages (no apt-get here); $without" >&2
    elif [ "$(id -u)" != 0 ]; then
        echo "setup: not installed: $packages; $without; fix: sudo apt-get install $packages" >&2
    else
        echo "setup: installing $packages" >&2
        log=$(mktemp)
        # shellcheck disable=SC2086 # a list of plain words
        { apt-get update -q && DEBIAN_FRONTEND=noninteractive apt-get install -q -y --no-install-recommends $packages; } \
            >"$log" 2>&1 </dev/null || {
            reason=$(grep '^E: ' "$log" | head -n 1)
            echo "setup: apt-get could not install $packages (${reason:-no message}); $without" >&2
        }
        rm -f "$log"
    fi
fi

# The kernel that the SocketCAN tests boot, once; the script says in one line where it cannot be had.
.ci/guest.py --fetch >&2 || :
