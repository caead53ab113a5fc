# Two commands are enough: `make demo` shows the toolkit at work, `make test` checks it. Both set up what they need.
.PHONY: demo test test-py312 env lint types bench format clean
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

# Every figure in docs/benchmarks comes from this.
bench: env
	for stage in refraction warp calibration; do .venv/bin/rainstereo bench $$stage --out $(OUT)/bench; done

clean:
	rm -rf .venv .venv312 $(OUT) build dist *.egg-info
