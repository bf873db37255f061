#!/bin/sh
# Tests what `setup.sh` says when something is missing, in a scratch project with stand-ins for all programs: every
# failure is one line on stderr with the fix, and exit 4; the packages of the Cortex-M tests are no reason to fail.
set -eu

here=$(cd "$(dirname "$0")" && pwd -P)
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
failures=0
bin=$scratch/bin

# A project folder (with a space), and a PATH that holds only what the script may use, all prerequisites met.
prepare() {
    rm -rf "$scratch/a project" "$bin"
    mkdir -p "$scratch/a project/.ci" "$bin"
    cp "$here/setup.sh" "$scratch/a project/.ci/"
    cp "$here/../rust-toolchain.toml" "$scratch/a project/"
    stub "$scratch/a project/.ci/mujoco.sh" 'exit 0'
    stub "$scratch/a project/.ci/cmake.sh" 'exit 0'
    stub "$scratch/a project/.ci/guest.py" 'exit 0'
    stub "$scratch/a project/.ci/python.sh" 'exit 0'
    for tool in sh cat cut dirname grep head mktemp printf rm sed sort tail uname; do
        ln -s "$(command -v "$tool")" "$bin/$tool"
    done
    for tool in cc c++ make; do
        stub "$bin/$tool" 'exit 0'
    done
    stub "$bin/qemu-system-arm" 'exit 0'
    stub "$bin/arm-none-eabi-gcc" 'exit 0'
    stub "$bin/qemu-system-x86_64" 'exit 0'
    stub "$bin/candump" 'exit 0'
    stub "$bin/busybox" 'exit 0'
    stub "$bin/id" 'echo 0'
    stub "$bin/apt-get" 'echo "$@" >>"'"$scratch"'/apt"'
    stub "$bin/cargo" 'exit 0'
    stub "$bin/rustc" 'echo "rustc 1.95.0 (hash date)"'
    # Remembers what it was asked to install; has the toolchain, and one target less than needed.
    stub "$bin/rustup" '
        case "$1 $2" in
        "toolchain list") echo "1.95.0-x86_64-unknown-linux-gnu (active)" ;;
        "target list") printf "thumbv7em-none-eabihf\nthumbv7m-none-eabi\nthumbv8m.main-none-eabihf\n" ;;
        "component list") printf "clippy-x86_64-unknown-linux-gnu\nrustfmt-x86_64-unknown-linux-gnu\n" ;;
        "toolchain install") echo "$@" >"'"$scratch"'/asked" ;;
        esac'
}

stub() {
    printf '#!/bin/sh\n%s\n' "$2" >"$1"
    chmod +x "$1"
}

# expect NAME CODE TEXT: runs the script; its last line on stderr must hold TEXT, and a failure must be one line.
expect() {
    code=0
    env -u RUSTUP_TOOLCHAIN -u GADM_CC -u CXX PATH="$bin" "$scratch/a project/.ci/setup.sh" 2>"$scratch/err" || code=$?
    lines=$(grep -c '' "$scratch/err" || true)
    if [ "$code" != "$2" ] || { [ -n "$3" ] && ! tail -n 1 "$scratch/err" | grep -q "$3"; } || [ "$lines" -gt 2 ]; then
        echo "FAILED: $1 (exit $code): $(cat "$scratch/err")"
        failures=$((failures + 1))
    else
        echo "ok: $1"
    fi
}

prepare && rm "$bin/cc"
expect "no C compiler" 4 "no C compiler (cc).*apt-get install build-essential"

prepare && rm "$bin/c++"
expect "no C++ compiler" 4 "no c++, which builds Box2D; install it (Debian: apt-get install build-essential)"

prepare && rm "$bin/make"
expect "no make" 4 "no make, which builds Box2D.*apt-get install build-essential"

prepare && stub "$scratch/a project/.ci/cmake.sh" 'echo "cmake: pip could not download it" >&2; exit 4'
expect "no CMake to be had" 4 "cmake: pip could not download it"

prepare && rm "$bin/cargo"
expect "no cargo" 4 "cargo not found; install Rust from https://rustup.rs"

prepare && stub "$scratch/a project/.ci/mujoco.sh" 'echo "mujoco: python3 not found; install it" >&2; exit 4'
expect "no python3" 4 "python3 not found; install it"

prepare
expect "a target is missing and comes" 0 "lacks: riscv32imac-unknown-none-elf; installing"
if ! grep -q "^toolchain install 1.95.0 .*--component clippy .*--target riscv32imac-unknown-none-elf" "$scratch/asked"; then
    echo "FAILED: rustup was asked: $(cat "$scratch/asked")"
    failures=$((failures + 1))
fi

prepare && stub "$bin/rustup" '
    case "$1 $2" in
    "toolchain list") echo "1.95.0-x86_64-unknown-linux-gnu (active)" ;;
    "toolchain install") echo "error: could not download file" >&2; exit 1 ;;
    esac'
expect "no network for the targets" 4 "could not install Rust .*error: could not download file.*check the network"

prepare && rm "$bin/rustup" && stub "$bin/rustc" 'echo "rustc 1.63.0"'
expect "an old Rust without rustup" 4 "rustc 1.63.0 is older than"

prepare && rm "$bin/rustup"
expect "a Rust without rustup" 0 ""

rm -f "$scratch/apt"
prepare
expect "both packages of the target tests are there" 0 ""
prepare && rm "$bin/qemu-system-arm" "$bin/arm-none-eabi-gcc" "$bin/apt-get"
expect "no packages and no apt-get" 0 "not installed: qemu-system-arm gcc-arm-none-eabi .*no apt-get.*will not run"
prepare && rm "$bin/qemu-system-arm" && stub "$bin/id" 'echo 1000'
expect "no emulator and no root" 0 "not installed: qemu-system-arm; .*will not run; fix: sudo apt-get install qemu-system-arm"
if [ -e "$scratch/apt" ]; then
    echo "FAILED: apt-get was asked without need: $(cat "$scratch/apt")"
    failures=$((failures + 1))
fi
prepare && rm "$bin/qemu-system-arm" "$bin/arm-none-eabi-gcc"
expect "no packages, as root" 0 "installing qemu-system-arm gcc-arm-none-eabi libnewlib-arm-none-eabi"
if ! grep -q "^install .* qemu-system-arm gcc-arm-none-eabi libnewlib-arm-none-eabi" "$scratch/apt"; then
    echo "FAILED: apt-get was asked: $(cat "$scratch/apt")"
    failures=$((failures + 1))
fi
prepare && rm "$bin/arm-none-eabi-gcc" "$bin/rustup" && stub "$bin/apt-get" 'echo "E: no network"; exit 100'
expect "no network for the packages" 0 "could not install gcc-arm-none-eabi .*(E: no network); .*will not run"

[ "$failures" = 0 ]
