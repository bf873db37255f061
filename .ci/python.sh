#!/bin/sh
# Brings the Python packages of tests/python/requirements.txt into <project>/target/python, an environment of its own:
# programs of the tests run with target/python/bin/python. Safe to run again: a complete one is recognised at once.
#
# Usage: .ci/python.sh [--check]      --check only tells whether it is there (exit 4 when not)
set -eu

fail() {
    echo "python: $1" >&2
    exit 4
}

root=$(cd "$(dirname "$0")/.." && pwd -P)
list=$root/tests/python/requirements.txt
dest=$root/target/python

# The stamp is the list and is written last, so an interrupted run or another list starts over.
if [ -x "$dest/bin/python" ] && cmp -s "$list" "$dest/stamp"; then
    exit 0
fi
[ "${1-}" != --check ] || fail "packages of tests/python/requirements.txt missing in $dest; run \`make setup\`"

command -v python3 >/dev/null 2>&1 || fail "python3 not found; install it (Debian: apt-get install python3 python3-pip) and run \`make setup\` again"
python3 -m pip --version >/dev/null 2>&1 || fail "python3 has no pip; install it (Debian: apt-get install python3-pip) and run \`make setup\` again"

mkdir -p "$root/target" 2>/dev/null || fail "cannot create $root/target; make the project folder writable and run \`make setup\` again"
log=$(mktemp "$root/target/python-setup.XXXXXX") || fail "cannot write in $root/target; free some space or make it writable and run \`make setup\` again"
trap 'rm -f "$log"' EXIT
trap 'exit 1' HUP INT TERM

echo "python: fetching the packages of tests/python/requirements.txt" >&2
# Without its own pip, the environment needs nothing that Debian keeps in a package apart (python3-venv).
python3 -m venv --clear --without-pip "$dest" >"$log" 2>&1 ||
    fail "python3 could not make an environment in $dest ($(tail -n 1 "$log")); remove that folder and run \`make setup\` again"
python3 -m pip --python "$dest/bin/python" install --quiet --disable-pip-version-check --no-deps --requirement "$list" \
    >"$log" 2>&1 || {
    reason=$(grep -v '^[[:space:]]*$' "$log" | tail -n 1)
    fail "pip could not install tests/python/requirements.txt (${reason:-no message}); check the network, pip's index setting and that pip is 22.3 or newer, and run \`make setup\` again"
}
cp "$list" "$dest/stamp"
