# Everything starts here: each target makes .venv first, if it is missing or its lock has changed.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready

.PHONY: demo test check bench format clean

demo: $(READY)  ## the rover manoeuvre on emulated drives; writes out/demo.mcap
	$(BIN)/motorhil demo

test: check  ## everything that must hold, on one machine, in minutes
	$(BIN)/python -m pytest

check: $(READY)  ## style, types and who may import whom
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

bench: $(READY)  ## figures against a peer in the same run; asserts no wall time
	$(BIN)/python -m tests.benchmarks

format: $(READY)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

$(READY): requirements.lock pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	touch $@

clean:
	rm -rf $(VENV) .venv-compiled build out *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis
