#!/bin/sh
# Brings the MuJoCo shared library into <project>/target/mujoco, out of the PyPI wheel of the engine version that
# `mujoco-rs` is built for.
#
# Usage: .ci/mujoco.sh [--check]      --check only tells whether the library is there (exit 4 when not)
set -eu

VERSION=3.17.0
# SHA-256 of the cp311 wheels.
SHA_X86_64=d66928d86a2d1b601bbaa4dc11db50214d17d5301bb8afd84721313b67ff0874
SHA_AARCH64=91a70ed9979c383ff1f5c03f25cc2e1280a8254c1a8e558d5dd7f4184f01efc9

lib=libmujoco.so.$VERSION
exec "$(dirname "$0")/wheel.sh" mujoco "$VERSION" "$SHA_X86_64" "$SHA_AARCH64" \
    "install MuJoCo $VERSION yourself and set MUJOCO_DYNAMIC_LINK_DIR to its lib folder" \
    mujoco/ "libmujoco.so=$lib" "$lib" "$@"
