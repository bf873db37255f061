#!/bin/sh
# Tests what `mujoco.sh` and `cmake.sh` say when something is missing, each in a scratch project and without a network: every
# failure is one line on stderr with the fix, exit 4, and leaves nothing behind.
set -eu

here=$(cd "$(dirname "$0")" && pwd -P)
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
failures=0
real_python=$(python3 -c 'import sys; print(sys.executable)')

# A project folder (with a space) and a PATH that holds only what the script may use.
setup() {
    rm -rf "$scratch/a project" "$scratch/bin"
    mkdir -p "$scratch/a project/.ci" "$scratch/bin"
    mkdir "$scratch/a project/.cargo"
    cp "$here/wheel.sh" "$here/mujoco.sh" "$here/cmake.sh" "$scratch/a project/.ci/"
    cp "$here/../.cargo/cmake" "$scratch/a project/.cargo/"
    for tool in sh cat dirname uname mkdir mktemp mv rm ls grep tail; do
        ln -s "$(command -v "$tool")" "$scratch/bin/$tool"
    done
}

# A python3 whose pip does what $1 says; everything else goes to the real one.
fake_python() {
    cat >"$scratch/bin/python3" <<FAKE
#!/bin/sh
if [ "\$1 \$2" = "-m pip" ]; then
    case "\$3" in
    --version) exit 0 ;;
    esac
    while [ "\$1" != --dest ]; do shift; done
    dest=\$2
    $1
fi
exec "$real_python" "\$@"
FAKE
    chmod +x "$scratch/bin/python3"
}

# expect NAME TEXT [SCRIPT]: runs the script and looks for TEXT in its only error line.
expect() {
    code=0
    env -u CMAKE PATH="$scratch/bin" "$scratch/a project/.ci/${3:-mujoco.sh}" 2>"$scratch/err" || code=$?
    lines=$(grep -c '' "$scratch/err" || true)
    if [ "$code" != 4 ] || ! tail -n 1 "$scratch/err" | grep -q "$2" || [ "$lines" -gt 2 ] ||
        [ -n "$(ls -A "$scratch/a project/target" 2>/dev/null)" ]; then
        echo "FAILED: $1 (exit $code): $(cat "$scratch/err"); left: $(ls -A "$scratch/a project/target" 2>/dev/null)" >&2
        failures=$((failures + 1))
    else
        echo "ok: $1"
    fi
}

setup
expect "no python3" "python3 not found; install it"

setup
printf '#!/bin/sh\nexit 1\n' >"$scratch/bin/python3" && chmod +x "$scratch/bin/python3"
expect "no pip" "python3 has no pip; install it"

setup
fake_python 'echo "ERROR: No matching distribution found for mujoco==3.17.0"; exit 1'
expect "no network" "could not download mujoco==3.17.0 (ERROR: No matching.*check the network"

setup
fake_python 'echo damaged >"$dest/mujoco-3.17.0-damaged.whl"; exit 0'
expect "damaged wheel" "has SHA-256 .*, expected .*pip cache purge"

setup
fake_python 'exit 0'
expect "no wheel" "left no wheel; upgrade pip"

setup
printf '#!/bin/sh\necho Plan9\n' >"$scratch/uname" && chmod +x "$scratch/uname" && mv "$scratch/uname" "$scratch/bin/uname"
expect "foreign system" "no pinned wheel for Plan9"

setup
expect "no CMake and no python3" "cmake: python3 not found; install it" cmake.sh

setup
fake_python 'echo "ERROR: No matching distribution found for cmake==3.31.6"; exit 1'
expect "no CMake and no network" "cmake: pip could not download cmake==3.31.6 (ERROR: No matching.*check the network" cmake.sh

setup
fake_python 'echo damaged >"$dest/cmake-3.31.6-damaged.whl"; exit 0'
expect "damaged wheel of CMake" "cmake: .* has SHA-256 .*, expected .*pip cache purge" cmake.sh

# succeeds NAME TEXT COMMAND...: runs it and looks for TEXT in what it prints.
succeeds() {
    name=$1 text=$2
    shift 2
    if env -u CMAKE PATH="$scratch/bin" "$@" >"$scratch/out" 2>&1 && grep -q "$text" "$scratch/out"; then
        echo "ok: $name"
    else
        echo "FAILED: $name: $(cat "$scratch/out")" >&2
        failures=$((failures + 1))
    fi
}

# `cargo build` finds the program on the PATH or, without one, that of the wheel; and says what to do without both.
setup
if env -u CMAKE PATH="$scratch/bin" "$scratch/a project/.cargo/cmake" --version 2>"$scratch/err" ||
    ! grep -q "CMake, which builds Box2D, is missing: run .make setup." "$scratch/err"; then
    echo "FAILED: no CMake in a build: $(cat "$scratch/err")" >&2
    failures=$((failures + 1))
else
    echo "ok: no CMake in a build"
fi
mkdir -p "$scratch/a project/target/cmake/bin"
printf '#!/bin/sh\necho of the wheel\n' >"$scratch/a project/target/cmake/bin/cmake"
chmod +x "$scratch/a project/target/cmake/bin/cmake"
succeeds "a build without CMake on the PATH" "of the wheel" "$scratch/a project/.cargo/cmake"
printf '#!/bin/sh\necho of the machine\n' >"$scratch/bin/cmake" && chmod +x "$scratch/bin/cmake"
succeeds "a build with CMake on the PATH" "of the machine" "$scratch/a project/.cargo/cmake"
if env -u CMAKE PATH="$scratch/bin" "$scratch/a project/.ci/cmake.sh" && [ ! -e "$scratch/a project/target/cmake/stamp" ]; then
    echo "ok: set-up with CMake on the PATH brings none"
else
    echo "FAILED: set-up with CMake on the PATH brings none" >&2
    failures=$((failures + 1))
fi

[ "$failures" = 0 ]
