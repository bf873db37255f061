#!/bin/sh
# Runs every fuzz target for SECONDS (default 30) on the stable toolchain and prints one line a target.
# Fails on the first crash; the input that crashed is named in the log that is printed then.
set -eu
cd "$(dirname "$0")"
seconds="${1:-30}"
host="$(rustc -vV | sed -n 's/^host: //p')"
target="${CARGO_TARGET_DIR:-$PWD/target}"
coverage="--cfg fuzzing -Cpasses=sancov-module -Cllvm-args=-sanitizer-coverage-level=4 \
-Cllvm-args=-sanitizer-coverage-inline-8bit-counters -Cllvm-args=-sanitizer-coverage-pc-table \
-Cllvm-args=-sanitizer-coverage-trace-compares -Ccodegen-units=1 -Clink-dead-code"
names="load act roundtrip codec node slcan hub"
# With --target the flags do not reach build scripts.
# shellcheck disable=SC2046 # one word a name
RUSTFLAGS="$coverage" cargo build --quiet --release --target "$host" --target-dir "$target" $(printf -- '--bin %s ' $names)
work="$target/fuzz"
for name in $names; do
    mkdir -p "$work/$name"
    log="$work/$name.log"
    if "$target/$host/release/$name" -max_total_time="$seconds" -max_len=8192 -rss_limit_mb=2048 -timeout=10 \
        -artifact_prefix="$work/$name-" "$work/$name" "corpus/$name" >"$log" 2>&1; then
        execs="$(sed -n 's/^Done \([0-9]*\) runs in \([0-9]*\) second.*/\1 execs in \2 s/p' "$log")"
        cover="$(grep -o 'cov: [0-9]*' "$log" | tail -n 1)"
        printf '%s: %s, %s, no crash\n' "$name" "$execs" "$cover"
    else
        cat "$log" >&2
        printf '%s: FAILED, see above; the input lies in %s\n' "$name" "$work" >&2
        exit 1
    fi
done
