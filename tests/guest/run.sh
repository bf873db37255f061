#!/bin/sh
# Tests of rung D on a kernel with CAN: node and plant as two processes on vcan0, with candump, cansend, canplayer and
# python-can beside them.
# Runs in the guest of .ci/guest.py (busybox) or on a host whose kernel has vcan, as root. One line a test.
#
# Usage: run.sh FOLDER      leaves there, for the caller to compare, traces named POLICY_PROFILE_EPISODES_SEED.log
# Environment: MODELS and PLANT say where the models and tests/python/plant.py lie, PYTHON is an interpreter with the
# packages of .ci/python.sh, or NO_PYTHON the reason why there is none.
set -u
out=$1
models=${MODELS:-/models}
plant=${PLANT:-/python/plant.py}
work=$(mktemp -d)
mkdir -p "$out" "$work"
failures=0
can=vcan0
# A host may have a vcan0 that is somebody's: then the tests make their own.
ip link show dev $can >/dev/null 2>&1 && can=gadm0
ip link add dev $can type vcan && ip link set $can mtu 72 && ip link set up $can || {
    echo "FAILED: cannot make a vcan interface"
    exit 1
}
children=
cleanup() {
    for child in $children; do kill "$child" 2>/dev/null; done
    ip link delete $can 2>/dev/null
}
trap cleanup EXIT

check() { # check NAME CONDITION...
    name=$1
    shift
    if "$@"; then
        echo "ok: $name"
    else
        echo "FAILED: $name"
        failures=$((failures + 1))
    fi
}

record() { # candump into FILE, in the background
    # All frames, and error frames too, which need a filter of their own.
    candump -L "$can,0:0,#FFFFFFFF" >"$1" 2>"$1.err" &
    recorder=$!
    children="$children $recorder"
    sleep 0.3
}

stop_recording() {
    sleep 0.5
    kill "$recorder" 2>/dev/null
    wait "$recorder" 2>/dev/null
}

# Frames without time stamps and name of the bus, FD flags without the mark that newer kernels set, and without the two
# requests of lockstep and their answers, which are in no trace.
frames() {
    cut -d ' ' -f 3 "$1" | sed -e 's/##[4-7]/&@/;s/##4@/##0/;s/##5@/##1/' | grep -v -E '^(581|601)#1[01]'
}

# lockstep POLICY PROFILE EPISODES SEED: two processes on the bus, candump's record and a run in process.
lockstep() {
    tag="$1_$2_$3_$4"
    policy=$models/$1/policy.bin
    record "$work/$tag.candump"
    timeout 400 gadm-sim node "$policy" --connect socketcan:$can --profile "$2" --quiet &
    node=$!
    children="$children $node"
    timeout 400 gadm-sim plant "$policy" --connect socketcan:$can --profile "$2" --episodes "$3" --seed "$4" \
        --trace "$out/$tag.log" --quiet
    check "$tag: node and plant as two processes on $can" [ $? = 0 ]
    kill $node
    wait $node 2>/dev/null
    stop_recording
    gadm-sim run "$policy" --profile "$2" --episodes "$3" --seed "$4" --trace "$work/$tag.here" --quiet
    check "$tag: trace = trace of a run in process, byte for byte" cmp "$work/$tag.here" "$out/$tag.log"
    frames "$work/$tag.candump" >"$work/$tag.seen"
    frames "$out/$tag.log" >"$work/$tag.sent"
    check "$tag: the plant sent frames" [ -s "$work/$tag.sent" ]
    check "$tag: candump saw the same $(wc -l <"$work/$tag.sent") frames in the same order" \
        cmp "$work/$tag.sent" "$work/$tag.seen"
}

lockstep inverted-pendulum-v5 fd-f32 1 3
lockstep hopper-v5 fd-f32 1 4
lockstep moving classic-i16 4 4

# replays LOG POLICY: every action of the log is what the policy decides.
replays() {
    timeout 400 gadm-sim replay "$1" --policy "$models/$2/policy.bin" --json >"$1.json" 2>/dev/null && grep -q '"same": true' "$1.json"
}

# played POLICY PROFILE EPISODES SEED: our trace through canplayer, candump's record of that, and that through us again.
played() {
    tag="$1_$2_$3_$4"
    check "$tag: candump's record of the live run replays to the same actions" replays "$work/$tag.candump" "$1"
    record "$work/$tag.played"
    timeout 400 canplayer -g 0 -I "$out/$tag.log" $can=vcan0
    check "$tag: canplayer plays our trace" [ $? = 0 ]
    stop_recording
    frames "$work/$tag.played" >"$work/$tag.again"
    check "$tag: candump saw the same frames in the same order" cmp "$work/$tag.sent" "$work/$tag.again"
    check "$tag: candump's record of what canplayer sent replays to the same actions" replays "$work/$tag.played" "$1"
}

played hopper-v5 fd-f32 1 4
played moving classic-i16 4 4

# A plant of Gymnasium with python-can on the bus, its frames from cantools: it drives our node for an episode, and its
# return is ours.
name="python-can on $can: a Hopper of Gymnasium drives our node for an episode"
if [ -n "${PYTHON-}" ]; then
    policy=$models/hopper-v5/policy.bin
    gadm-sim dbc "$policy" -o "$work/hopper.dbc"
    gadm-sim reset hopper-v5 --seed 4 >"$work/start.json"
    timeout 400 gadm-sim node "$policy" --connect socketcan:$can --quiet &
    node=$!
    children="$children $node"
    timeout 400 "$PYTHON" "$plant" --dbc "$work/hopper.dbc" --start "$work/start.json" --interface socketcan --channel $can \
        >"$work/theirs.json"
    check "$name" [ $? = 0 ]
    kill $node
    wait $node 2>/dev/null
    gadm-sim run "$policy" --episodes 1 --seed 4 --json --quiet >"$work/ours.json"
    check "$name: return and steps are ours" "$PYTHON" -c '
import json, sys
theirs, ours = (json.load(open(path))["episodes"][0] for path in sys.argv[1:])
print({key: (theirs[key], ours[key]) for key in ("return", "steps")})
sys.exit(any(theirs[key] != ours[key] for key in ("return", "steps")))
' "$work/theirs.json" "$work/ours.json"
else
    echo "not run: $name (${NO_PYTHON:-no Python environment; run .ci/python.sh})"
fi

# A run that starts its node itself, while others send: a classic and an FD frame that concern nobody, then an emergency
# stop, which the node obeys.
policy=$models/inverted-pendulum-v5/policy.bin
record "$work/inject.candump"
timeout 400 gadm-sim run "$policy" --bus socketcan:$can --episodes 400 --seed 5 --trace "$work/inject.log" --quiet --json \
    >"$work/inject.json" 2>"$work/inject.err" &
run=$!
children="$children $run"
seconds=0
# Control has begun when the plant has got actions.
until grep -q ' 101##' "$work/inject.candump" 2>/dev/null || [ $seconds = 60 ]; do
    seconds=$((seconds + 1))
    sleep 1
done
cansend $can 7A1#DEADBEEF
cansend $can 12345678##1112233445566778899AABBCC
cansend $can 010#42
sleep 2
kill $run 2>/dev/null
wait $run 2>/dev/null
stop_recording
seen() { grep -q " $1" "$work/inject.candump"; }
after() { sed -n '/ 010#42/,$p' "$work/inject.candump" | cut -d ' ' -f 3; }
check "cansend: a classic frame reached the bus" seen '7A1#DEADBEEF'
check "cansend: an FD frame reached the bus" seen '12345678##[15]112233445566778899AABBCC'
check "cansend: an emergency stop reached the bus" seen '010#42'
# State 5 is SAFE, fault 11 the emergency stop; an action with the flag `safe` follows.
stopped() { after | grep -q -E '^701#05..0B'; }
safe() { after | grep -E '^101##' | head -n 3 | grep -q -E '^101##[0-9A-F].{6}[0-9A-F][89A-F]'; }
check "emergency stop: the node says SAFE for it" stopped
check "emergency stop: the safe action follows" safe

# The controller's own words: bus-off, as the kernel reports it.
record "$work/off.candump"
timeout 400 gadm-sim run "$policy" --bus socketcan:$can --episodes 400 --seed 6 --quiet >/dev/null 2>"$work/off.err" &
run=$!
children="$children $run"
seconds=0
until grep -q ' 101##' "$work/off.candump" 2>/dev/null || [ $seconds = 60 ]; do
    seconds=$((seconds + 1))
    sleep 1
done
cansend $can 20000040#0000000000000000
sleep 2
kill $run 2>/dev/null
wait $run 2>/dev/null
stop_recording
busoff() { sed -n '/20000040#/,$p' "$work/off.candump" | cut -d ' ' -f 3 | grep -q '^701#05..09'; }
check "bus-off: the node goes to SAFE and says why" busoff

# Several at once: the hub with vcan as one of its members passes frames both ways.
gadm-sim bus hub --unix "$work/hub.sock" --socketcan $can --quiet &
hub=$!
children="$children $hub"
sleep 1
timeout 400 gadm-sim node "$policy" --connect "unix:$work/hub.sock" --quiet &
node=$!
children="$children $node"
timeout 400 gadm-sim plant "$policy" --connect socketcan:$can --episodes 1 --seed 3 --trace "$work/gateway.log" --quiet
check "gateway: node at a hub, plant on $can" [ $? = 0 ]
check "gateway: same trace as in process" cmp "$work/inverted-pendulum-v5_fd-f32_1_3.here" "$work/gateway.log"
kill $node $hub 2>/dev/null

rm -rf "$work"
[ $failures = 0 ]
