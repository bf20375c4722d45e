# Everything starts here: each target makes .venv first, if it is missing or its lock has changed.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready

COMPILED := .venv-compiled
PACKAGES := motorapi emulators traces harness

.PHONY: demo test check bench format clean compiled test-compiled

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

compiled: $(COMPILED)/.ready  ## the hot cores as C extensions, in an environment of their own

test-compiled: compiled  ## the tests again, against the compiled cores
	rm -rf build/tests && mkdir -p build/tests && cp -r tests pyproject.toml build/tests/
	cd build/tests && MOTORHIL_CHECKOUT=$(CURDIR) ../../$(COMPILED)/bin/python -m pytest

SOURCES := $(shell find $(PACKAGES) -name '*.py' -o -name '*.eds' -o -name '*.toml' -o -name '*.json')
$(COMPILED)/.ready: requirements.lock pyproject.toml setup.py $(SOURCES)
	test -x $(COMPILED)/bin/python || $(PYTHON) -m venv $(COMPILED)
	$(COMPILED)/bin/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock
	rm -rf build/compiled && mkdir -p build/compiled
	cp -r $(PACKAGES) pyproject.toml setup.py README.md LICENSE build/compiled/
	cd build/compiled && MOTORHIL_COMPILE=1 ../../$(COMPILED)/bin/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --force-reinstall .
	touch $@

clean:
	rm -rf $(VENV) .venv-compiled build out *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis
