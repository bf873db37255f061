# Two commands for newcomers: `make demo` and `make test`. Everything they do is in .ci/, one script each.
.PHONY: help setup demo test firmware bench-target bench-peers test-peers soak

help:
	@echo "make setup   bring or check what is needed: MuJoCo library, CMake, Rust targets (quick when all is there)"
	@echo "make demo    learn, export and drive InvertedPendulum over the simulated bus; then fly Hopper"
	@echo "make test    all checks and tests, cheapest first; STAGES=\"fmt clippy\" picks some (.ci/test.py --list)"
	@echo "make firmware   the controller as firmware for three boards, in target/firmware; BOARDS=\"mps2-an386\" picks some"
	@echo "make bench-target   instructions, code, weights, memory and stack on emulated Cortex-M4 and M7, with goals and budgets"
	@echo "make bench-peers   training speed beside PyTorch, gymnasium and envpool (brings about 5 GB)"
	@echo "make test-peers   one update of every baseline learner compared with PyTorch, number by number (brings the same)"
	@echo "make soak    a million control steps over a hub with random faults: every frame accounted for, memory flat"
	@echo
	@echo "Afterwards plain cargo works too: cargo build, cargo test, cargo run --release --bin gadm -- --help"

setup:
	@.ci/setup.sh

demo: setup
	@.ci/demo.py

test: setup
	@.ci/test.py $(STAGES)

# PEERS: options of tests/peers/run.py.
bench-peers: setup
	@.ci/peers.sh $(PEERS)

test-peers: setup
	@.ci/peers-test.sh

firmware:
	@firmware-sim/firmware/build.sh $(BOARDS)

bench-target:
	@.ci/bench-target.py $(if $(JSON),--json)

soak: setup
	cargo run --locked --release -p gadm-sim --bin gadm-sim -- soak models/inverted-pendulum-v5/policy.bin $(if $(STEPS),--steps $(STEPS))
