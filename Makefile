# make demo, make test: both set up everything they need, from a clean checkout.
# Another interpreter: make install PYTHON=/path/to/python3.12 (any Python >= 3.11).

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help install demo test test-vcan test-can-hw quick live soak soak-loopbus soak-vcan0 design wheel clean

VENV := .venv
STAMP := $(VENV)/.installed
BIN := $(VENV)/bin
TEST_WORKERS ?= 2

help:
	@echo "make demo     the car takes the test by itself, forward and in reverse (about 40 s); more: .venv/bin/parkctl demo --help"
	@echo "make test     lint, format, types, all tests"
	@echo "make test-vcan  only those on a real vcan0, in a guest kernel (2 min; once before: .venv/bin/parkctl guest --install)"
	@echo "make test-can-hw  the driver of a physical interface: two emulated CAN cards, slow motion (10 min; needs QEMU)"
	@echo "make soak     18 tests in a row on loopbus, then on vcan0, cyclictest beside them (20 min; SOAK_RUNS=2 for a look)"
	@echo "make design   makes the shipped tables anew from the vehicle and course files"
	@echo "make wheel    builds dist/parkctl_controller-*.whl, the controller alone, for the car"
	@echo "make install  .venv with everything in it (demo and test do this by themselves)"
	@echo "make clean    removes .venv and what the tools cached"

install: $(STAMP)

# The first interpreter that is new enough; candidates are tried by running them (a shim may exist and not work).
# A .venv that works is brought up to date, a half-made one is made anew; the stamp is written last.
$(STAMP): pyproject.toml constraints.txt
	@if $(BIN)/python -c 'import sys, pip; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then exit 0; fi; \
	python=; \
	for candidate in $(or $(PYTHON),python3 python3.13 python3.12 python3.11); do \
	  if "$$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then python=$$candidate; break; fi; \
	done; \
	if [ -z "$$python" ]; then \
	  echo "make: error: no Python >= 3.11 found (tried: $(or $(PYTHON),python3 python3.13 python3.12 python3.11));" \
	    "install one, or name it: make install PYTHON=/path/to/python3.11" >&2; exit 1; \
	fi; \
	"$$python" -c 'import ensurepip, venv' 2>/dev/null || { \
	  echo "make: error: $$python cannot make virtual environments; on Debian and Ubuntu install python3-venv" >&2; exit 1; }; \
	echo "setting up $(VENV) with $$("$$python" --version) (once; takes about a minute)"; \
	"$$python" -m venv --clear $(VENV)
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[tools,cluster,test]' -c constraints.txt
	@touch $@

demo: $(STAMP)
	@$(BIN)/parkctl demo

design: $(STAMP)
	@$(BIN)/parkctl design --update

wheel: $(STAMP)
	@$(BIN)/parkctl deploy wheel --out dist

test: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(MAKE) --no-print-directory quick live

quick: $(STAMP)
	$(BIN)/pytest -n $(TEST_WORKERS) -m "not live"

# Real processes in wall-clock time: one at a time, or they would disturb each other.
live: $(STAMP)
	$(BIN)/pytest -m live

# Part of `live` too, where the guest is installed.
test-vcan: $(STAMP)
	$(BIN)/pytest tests/test_vcan_live.py tests/test_vcan_mistakes.py

# Says first how long it takes; SLOW_MOTION=10 is quicker, on an idle machine. Where something is missing it says what.
test-can-hw: $(STAMP)
	@$(BIN)/pytest -q -s tests/can_hw.py

SOAK_RUNS ?= 18
soak: soak-loopbus soak-vcan0

soak-loopbus: $(STAMP)
	@mkdir -p runs
	$(BIN)/parkctl soak --runs $(SOAK_RUNS) --json runs/soak_loopbus.json

soak-vcan0: $(STAMP)
	$(BIN)/parkctl guest -- parkctl soak --runs $(SOAK_RUNS) -i socketcan -c vcan0 --json runs/soak_vcan0.json

clean:
	rm -rf $(VENV) .pytest_cache .mypy_cache .ruff_cache .hypothesis .benchmarks *.egg-info
