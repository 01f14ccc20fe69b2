# Two commands do everything on a fresh machine: `make sim` and `make test`.
PYTHON ?= python3
DURATION ?= 30
ROUNDS ?= 100
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready

# Without compiled modules every process that a test starts, and every worker, would compile all of them again.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help sim foreign test collected faults stacks lint web openxr release page holder worlds grasps format clean

help:
	@echo "make sim      set up, then run the simulated rig for $(DURATION) s (DURATION=60 for longer)"
	@echo "make test     set up, then lint, types, layers and all tests"
	@echo "make faults   the long rounds that make test leaves out: kills, partitions, clocks, systemd (ROUNDS=1: minutes; $(ROUNDS): hours)"
	@echo "make stacks   drivers and files on the software they were written for: kernels, SDKs, engines (STACKS=\"v4l2 arm64\": only these)"
	@echo "make foreign  programs of others that tests hand our output to (make test calls it)"
	@echo "make lint     only lint, types and layers"
	@echo "make web      build the page Grasp (node and npm); sim and test do it where these are there"
	@echo "make openxr   build the OpenXR layer, build/openxr (needs a C compiler and libopenxr-dev)"
	@echo "make release  build wheel and source distribution, build/dist, and try them in fresh environments"
	@echo "make holder   write the printable camera holder, build/holder/*.stl (docs/build.md)"
	@echo "make worlds   render photo-real pictures of random rigs and hands with Blender (SEEDS=\"1 2\" SCORER=…/score.py)"
	@echo "make grasps   measure fingers in random grasps, without pictures (HALF=held-back)"
	@echo "make clean    remove the environment and caches"

# pip would compile every module of every package; python compiles the few that are used when it first loads them.
QUICKLY := --disable-pip-version-check --no-compile
# Counts what pip says of each package; its errors and warnings go past it.
COUNTED := | awk '/^ *Collecting/ {printf "\r  %d packages: %-40s", ++n, $$2; fflush()} END {printf "\r  %d packages%-44s\n", n, ""}'
SHELL := bash
.SHELLFLAGS := -o pipefail -c

# The environment is made once and again whenever what it is made from changes.
$(READY): pyproject.toml bench/pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "RHOT needs Python 3.11 or newer, $(PYTHON) is $$($(PYTHON) --version); try make PYTHON=python3.12"; exit 1; }
	@echo "setting up $(VENV), once (about a minute)"
	@$(PYTHON) -m venv $(VENV)
	@$(BIN)/python -m pip install $(QUICKLY) --editable '.[dev]' --editable bench --constraint constraints.txt $(COUNTED)
	@touch $@

# What runs on Windows and macOS, too: all but the tests.
OURS := common services calibration simulation tools bench/rhot_bench worlds

# Programs of others that tests hand our output to; tests that need one are skipped where it cannot be installed.
NPM := .foreign/npm/.ready
ROS := .foreign/ros/.ready

$(NPM): tests/foreign/package.json
	@command -v node >/dev/null && command -v npm >/dev/null
	@mkdir -p $(@D) && cp $< $(@D)/
	@cd $(@D) && npm install --silent --no-audit --no-fund --no-package-lock --ignore-scripts
	@touch $@

$(ROS): tests/foreign/ros.txt
	@$(PYTHON) -m venv $(@D)
	@$(@D)/bin/python -m pip install $(QUICKLY) --quiet --prefer-binary --requirement $<
	@touch $@

foreign:
	@$(MAKE) --no-print-directory $(NPM) 2>/dev/null || echo "going on without programs of npm (needs node and npm)"
	@$(MAKE) --no-print-directory $(ROS) 2>/dev/null || echo "going on without ROS 2 (there are no packages for this machine)"

# The page Grasp. Without node and npm everything else works, and the page says what is missing.
BUNDLE := services/viewer/rhot_viewer/static/grasp.js
SOURCES := $(wildcard web/src/*) web/build.mjs web/package.json web/package-lock.json

web: $(BUNDLE)
	@:

$(BUNDLE): $(SOURCES)
	@command -v node >/dev/null && command -v npm >/dev/null || \
	  { echo "the page Grasp needs node and npm: apt install nodejs npm"; exit 1; }
	@echo "building the page Grasp"
	@cd web && npm ci --silent --no-audit --no-fund && node build.mjs

release: web
	@deploy/release.sh $(PYTHON) build/dist

openxr: $(READY)
	@$(BIN)/python -m rhot_bridge.openxr_layer build/openxr/librhot_openxr.so && echo "build/openxr/librhot_openxr.so is built"

holder: $(READY)
	@$(BIN)/python docs/make_holder.py $(HOLDER)

# Photo-real sets for `rhot evaluate pictures`: half an hour of one core each (docs/data.md).
BLENDER := .foreign/blender/.ready
SEEDS ?= 1
WORLDS ?= build/worlds
HALF ?= develop
SCORER ?= ../shared/data/rendered/score.py

$(BLENDER): worlds/requirements.txt
	@$(PYTHON) -m venv $(@D)
	@$(@D)/bin/python -m pip install $(QUICKLY) --requirement $< $(COUNTED)
	@touch $@

worlds: $(BLENDER)
	@PYTHONPATH=.:common nice $(dir $(BLENDER))bin/python -m worlds $(SEEDS) --out $(WORLDS) --scorer $(SCORER)

# Fingers in a grasp, without pictures: six minutes of two cores each half.
grasps: $(READY)
	@$(BIN)/python -m worlds.grasps --half $(HALF) --jobs 2

page:
	@$(MAKE) --no-print-directory web || echo "going on without the page Grasp"

sim: $(READY) page
	@$(BIN)/rhot sim --duration $(DURATION)

# Where tests may be whose limits are times on the clock of real processes; tests/conftest.py refuses them elsewhere.
REAL_TIME := tests/integration tests/faults

# Tests of real processes wait for a sixth of their time: one worker more than there are cores computes meanwhile.
WORKERS := $(shell expr $$(nproc || getconf _NPROCESSORS_ONLN) + 1)

# Programs of others and the page are fetched and built while the environment is set up, which keeps one core busy.
# What is judged by the clock wants both cores to itself; everything else shares them.
test:
	@$(MAKE) --no-print-directory --jobs 4 foreign page lint collected
	@$(BIN)/pytest --numprocesses $(WORKERS) --dist loadgroup -m "not faults and not stacks and not (integration and real_time)" -rs
	@$(BIN)/pytest -m "integration and real_time and not faults and not stacks" -rs $(REAL_TIME)

# Compiles all tests, since workers that find nothing compiled would each do it; a test that cannot be imported ends here.
collected: $(READY)
	@$(BIN)/pytest -q --collect-only > $(VENV)/collected || { cat $(VENV)/collected; exit 1; }

# As root on Debian it installs what is missing; emulated machines are kept in .stacks (7 GB).
stacks: $(READY)
	@$(BIN)/python tests/stacks/run.py $(STACKS)

faults: $(READY) page
	@RHOT_FAULTS_ROUNDS=$(ROUNDS) $(BIN)/pytest -m faults -rs

lint: $(READY)
	@$(BIN)/ruff check
	@$(BIN)/ruff format --check
	@$(BIN)/mypy --num-workers 2 || { \
	  test $$? -eq 2 && echo "mypy again, in one process: its workers must be there within 3 s" && $(BIN)/mypy; }
	@for system in win32 darwin; do \
	  $(BIN)/mypy --platform $$system --num-workers 2 $(OURS) | sed "s/^Success/$$system: success/" || exit 1; done
	@$(BIN)/lint-imports --no-logo

format: $(READY)
	@$(BIN)/ruff format
	@$(BIN)/ruff check --fix

clean:
	rm -rf web/node_modules services/viewer/rhot_viewer/static .foreign .stacks $(VENV) .pytest_cache .ruff_cache .mypy_cache .hypothesis .import_linter_cache
