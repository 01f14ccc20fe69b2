# Two commands do everything on a fresh machine: `make sim` and `make test`.
PYTHON ?= python3
DURATION ?= 30
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready

.PHONY: help sim test lint format clean

help:
	@echo "make sim    set up, then run the simulated rig for $(DURATION) s (DURATION=60 for longer)"
	@echo "make test   set up, then lint, types, layers and all tests"
	@echo "make lint   only lint, types and layers"
	@echo "make clean  remove the environment and caches"

# The environment is made once and again whenever what it is made from changes.
$(READY): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "RHOT needs Python 3.11 or newer, $(PYTHON) is $$($(PYTHON) --version); try make PYTHON=python3.12"; exit 1; }
	@echo "setting up $(VENV), once (about a minute)"
	@$(PYTHON) -m venv $(VENV)
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]' --constraint constraints.txt
	@touch $@

sim: $(READY)
	@$(BIN)/rhot sim --duration $(DURATION)

# Real processes want both cores to themselves; everything else shares them.
test: lint
	@$(BIN)/pytest --numprocesses auto --dist loadgroup -m "not integration and not faults" -rs
	@$(BIN)/pytest -m "integration and not faults" -rs

lint: $(READY)
	@$(BIN)/ruff check
	@$(BIN)/ruff format --check
	@$(BIN)/mypy --num-workers 2
	@$(BIN)/lint-imports --no-logo

format: $(READY)
	@$(BIN)/ruff format
	@$(BIN)/ruff check --fix

clean:
	rm -rf $(VENV) .pytest_cache .ruff_cache .mypy_cache .hypothesis .import_linter_cache
