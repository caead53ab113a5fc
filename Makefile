# Two commands are enough: `make demo` shows the toolkit at work, `make test` checks it. Both set up what they need.
.PHONY: demo test firmware-test rig-test test-py312 env lint types bench pictures weights format clean
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

# Cameras over GigE Vision: Aravis's fake ones, in a network of their own; installs Debian's packages for that.
rig-test: env
	@.ci/rig .venv
	$(RUN) pytest tests/hardware/test_live_rig.py tests/hardware/test_capture.py tests/hardware/test_recording.py tests/apps/test_record.py

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

# The weights that the package ships. CAMVID: a folder that holds CamVid's train and val images. Three and a half hours on 2 cores.
COVERS = 0.35 0.2 0.5 0.28 0.65 0.42 0.08 0.3 0.4 0.55 0.24 0.75
weights: env
	@test -d "$(CAMVID)/train" -a -d "$(CAMVID)/val" || { echo "give CAMVID=FOLDER, with CamVid's images in FOLDER/train and FOLDER/val"; exit 1; }
	mkdir -p $(OUT)/weights && ln -sfn "$(abspath $(CAMVID))" $(OUT)/weights/camvid
	n=0; for cover in $(COVERS); do n=$$((n + 1)); .venv/bin/rainstereo rain $(OUT)/weights/camvid/train \
	  --out $(OUT)/weights/bank/$$n --preset camvid --cover $$cover --seed $$((1000 + n)) --no-drop-lists --no-ssim || exit 1; done
	.venv/bin/rainstereo rain $(OUT)/weights/camvid/val --out $(OUT)/weights/val --preset camvid --psnr 16.9 --seed 777 --no-drop-lists
	.venv/bin/rainstereo train docs/recipes/compact.toml --out $(OUT)/weights/compact

clean:
	rm -rf .venv .venv312 $(OUT) build dist *.egg-info
