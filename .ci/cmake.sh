#!/bin/sh
# Makes sure that CMake is there, which builds the Box2D sources inside the crate wrapped2d: the one that CMAKE names or
# that is on the PATH, else the one of the PyPI wheel, in <project>/target/cmake. `.cargo/cmake` looks in the same order.
#
# Usage: .ci/cmake.sh [--check]      --check only tells whether one is there (exit 4 when not)
set -eu

VERSION=3.31.6
SHA_X86_64=1c8b05df0602365da91ee6a3336fe57525b137706c4ab5675498f662ae1dbcec
SHA_AARCH64=42d9883b8958da285d53d5f69d40d9650c2d1bcf922d82b3ebdceb2b3a7d4521

if "${CMAKE:-cmake}" --version >/dev/null 2>&1; then
    exit 0
fi
here=$(cd "$(dirname "$0")" && pwd -P)
"$here/wheel.sh" cmake "$VERSION" "$SHA_X86_64" "$SHA_AARCH64" \
    "install cmake yourself (Debian: apt-get install cmake) and run \`make setup\` again" \
    cmake/data/ "" bin/cmake "share/cmake-${VERSION%.*}/" "$@"
"$here/../target/cmake/bin/cmake" --version >/dev/null 2>&1 || {
    echo "cmake: the program of the $VERSION wheel does not run on this system; install cmake yourself (Debian: apt-get install cmake) and run \`make setup\` again" >&2
    exit 4
}
