#!/bin/sh
# Brings the MuJoCo shared library into <project>/target/mujoco, out of the PyPI wheel of the engine version that
# `mujoco-rs` is built for. Safe to run again: a complete installation is recognised at once.
#
# Usage: .ci/mujoco.sh [--check]      --check only tells whether the library is there (exit 4 when not)
set -eu

VERSION=3.17.0
# SHA-256 of the cp311 wheels. The interpreter tag only names the Python bindings, which are not used, so any Python 3
# with pip can fetch them.
SHA_X86_64=d66928d86a2d1b601bbaa4dc11db50214d17d5301bb8afd84721313b67ff0874
SHA_AARCH64=91a70ed9979c383ff1f5c03f25cc2e1280a8254c1a8e558d5dd7f4184f01efc9

fail() {
    echo "mujoco: $1" >&2
    exit 4
}

root=$(cd "$(dirname "$0")/.." && pwd -P)
dest=$root/target/mujoco
lib=libmujoco.so.$VERSION

os=$(uname -s)
arch=$(uname -m)
case $os-$arch in
Linux-x86_64) sha=$SHA_X86_64 ;;
Linux-aarch64 | Linux-arm64) sha=$SHA_AARCH64 arch=aarch64 ;;
*) fail "no pinned wheel for $os on $arch; install MuJoCo $VERSION yourself and set MUJOCO_DYNAMIC_LINK_DIR to its lib folder" ;;
esac

# The stamp holds the wheel's hash and is written last, so an interrupted run or another version starts over.
if [ -f "$dest/$lib" ] && [ -f "$dest/libmujoco.so" ] && [ "$(cat "$dest/stamp" 2>/dev/null)" = "$sha" ]; then
    exit 0
fi
[ "${1-}" != --check ] || fail "library missing in $dest; run \`make setup\`"

command -v python3 >/dev/null 2>&1 || fail "python3 not found; install it (Debian: apt-get install python3 python3-pip) and run \`make setup\` again"
python3 -m pip --version >/dev/null 2>&1 || fail "python3 has no pip; install it (Debian: apt-get install python3-pip) and run \`make setup\` again"

mkdir -p "$root/target" 2>/dev/null || fail "cannot create $root/target; make the project folder writable and run \`make setup\` again"
work=$(mktemp -d "$root/target/mujoco-setup.XXXXXX") || fail "cannot write in $root/target; free some space or make it writable and run \`make setup\` again"
trap 'rm -rf "$work"' EXIT
trap 'exit 1' HUP INT TERM

echo "mujoco: fetching the $VERSION wheel for $arch" >&2
if ! python3 -m pip download --quiet --disable-pip-version-check --no-deps --only-binary=:all: \
    --implementation cp --python-version 3.11 --abi cp311 \
    --platform "manylinux_2_28_$arch" --platform "manylinux_2_27_$arch" \
    --dest "$work" "mujoco==$VERSION" >"$work/pip.log" 2>&1; then
    reason=$(grep -v '^[[:space:]]*$' "$work/pip.log" | tail -n 1)
    fail "pip could not download mujoco==$VERSION (${reason:-no message}); check the network or pip's index setting and run \`make setup\` again"
fi

set -- "$work"/*.whl
[ -f "$1" ] || fail "pip reported success but left no wheel; upgrade pip (need 20.3 or newer) and run \`make setup\` again"
python3 - "$1" "$sha" "$work/new" "$lib" <<'PYTHON' || exit 4
import hashlib, os, shutil, sys, zipfile

wheel, expected, folder, library = sys.argv[1:]
found = hashlib.sha256(open(wheel, "rb").read()).hexdigest()
if found != expected:
    sys.exit(f"mujoco: {os.path.basename(wheel)} has SHA-256 {found}, expected {expected}; "
             "the download is damaged or not the published file: clear pip's cache (python3 -m pip cache purge) "
             "and run `make setup` again")
os.mkdir(folder)
with zipfile.ZipFile(wheel) as archive:
    for name in archive.namelist():
        base = os.path.basename(name)
        licence = "LICENSE" in base.upper() or "NOTICE" in base.upper()
        if name == f"mujoco/{library}" or (licence and ".dist-info/" in name):
            with archive.open(name) as source, open(os.path.join(folder, base), "wb") as target:
                shutil.copyfileobj(source, target)
if not os.path.isfile(os.path.join(folder, library)):
    sys.exit(f"mujoco: the wheel holds no mujoco/{library}; the pinned version and the pinned hash do not belong together")
os.chmod(os.path.join(folder, library), 0o755)
os.symlink(library, os.path.join(folder, "libmujoco.so"))
with open(os.path.join(folder, "stamp"), "w") as stamp:
    stamp.write(expected + "\n")
PYTHON

# A rename puts the finished folder in place; an older one moves away first.
[ ! -e "$dest" ] || mv "$dest" "$work/old"
mv -T "$work/new" "$dest" || fail "cannot move the library to $dest; make it writable and run \`make setup\` again"
echo "mujoco: $lib is in $dest" >&2
