# Two commands are enough: `make demo` shows the toolkit at work, `make test` checks it. Both set up what they need.
.PHONY: demo test firmware-test test-py312 env lint types bench pictures format clean
OUT ?= out
RUN = .venv/bin/python -m
JOBS ?= 2

demo: env
	.venv/bin/rainstereo demo --out $(OUT)/demo

test: env lint types
	$(RUN) pytest -n $(JOBS)

# The core and the calibration on Python 3.12 with numpy 2 and mrcal 2.5, where such an interpreter exists.
PYTHON312 ?= $(firstword $(shell command -v python3.12 python3.13))
test-py312:
	@test -n "$(PYTHON312)" || { echo "missing: python3.12 (sudo apt-get install python3.12-venv, or PYTHON312=...)"; exit 1; }
	@.ci/environment .venv312 "$(PYTHON312)"
	.venv312/bin/python -m pytest -n $(JOBS) tests/core tests/calib

# The pump's firmware natively, as a sketch on a simulated ATmega328P, and fuzzed; installs Debian's packages for that.
firmware-test: env
	@.ci/firmware
	$(RUN) pytest tests/hardware tests/apps/test_pump.py

env:
	@.ci/environment .venv

lint: env
	@$(RUN) ruff format --check .
	@$(RUN) ruff check .

types: env
	@$(RUN) mypy

format: env
	@$(RUN) ruff format .
	@$(RUN) ruff check --fix .

# Every page in docs/benchmarks comes from this (a quiet machine, 15 minutes).
bench: env
	.venv/bin/rainstereo bench all --out $(OUT)/bench --docs docs/benchmarks

# Every picture of the tutorial and the README comes from this.
pictures: env
	.venv/bin/rainstereo demo --out $(OUT)/demo --pictures $(OUT)/pictures
	for name in $$(grep -oh 'images/[a-z0-9/.-]*' README.md docs/tutorial.md | sort -u); do \
	  mkdir -p "docs/$$(dirname $$name)" && cp "$(OUT)/pictures/$${name#images/}" "docs/$$name"; done

clean:
	rm -rf .venv .venv312 $(OUT) build dist *.egg-info
