# Everything starts here: each target makes .venv first, if it is missing or its lock has changed.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready

COMPILED := .venv-compiled
OPTIMISE := 2
PACKAGES := motorapi emulators traces harness
# A third one would save a minute, and hurry what goes by the wall (tests/conftest.py).
WORKERS := -n 2 --dist loadfile --no-loadscope-reorder

# What was read once is not compiled or rewritten anew by each of the hundreds of programs that the
# tests start, whatever the environment says; nor does it lie among the sources.
test test-compiled: export PYTHONDONTWRITEBYTECODE :=
test test-compiled: export PYTHONPYCACHEPREFIX := $(CURDIR)/build/bytecode

.PHONY: demo test check bench fuzz mutants clauses golden format clean compiled build-compiled test-compiled

demo: $(READY)  ## the rover manoeuvre on emulated drives; writes out/demo.mcap
	$(BIN)/motorhil demo

test: check  ## everything that must hold, on one machine, in minutes
	$(BIN)/python -m pytest $(WORKERS)

check: $(READY)  ## style, types and who may import whom
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

bench: $(READY)  ## figures against a peer in the same run; asserts no wall time
	$(BIN)/python -m tests.benchmarks

fuzz: $(READY)  ## a million random, mutated and recorded frames at the drive; FUZZ="--seed N --frames N"
	$(BIN)/python -m tests.fuzz $(FUZZ)

mutants: $(READY)  ## every adaptation broken on purpose against every clause; writes the kill table
	$(BIN)/python -m tests.conformance.mutants $(MUTANTS)

clauses: $(READY)  ## docs/CLAUSES.md, every clause of the conformance kit
	$(BIN)/python -m harness.conformance.clauses_page > docs/CLAUSES.md

golden: $(READY)  ## the golden recordings again, where a rig does something else today
	$(BIN)/python -m tests.golden

format: $(READY)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

$(READY): requirements.lock pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	touch $@

compiled: $(READY)  ## the hot cores as C extensions, in an environment of their own
	@digest=$$(find $(PACKAGES) setup.py pyproject.toml requirements.lock -type f ! -name '*.pyc' \
	    -exec sha256sum {} + | LC_ALL=C sort | sha256sum)$(OPTIMISE); \
	if [ "$$(cat $(COMPILED)/.source 2>/dev/null)" != "$$digest" ]; then \
	    $(MAKE) --no-print-directory build-compiled && echo "$$digest" > $(COMPILED)/.source; fi

# Built from a copy, for a .so beside the sources would hide them; with the dependencies of .venv.
# What was built before is used again, as long as the same modules are compiled in the same way.
COPIED := $(PACKAGES) pyproject.toml setup.py README.md LICENSE
PURELIB := import sysconfig; print(sysconfig.get_path('purelib'))
build-compiled: $(READY)
	@mkdir -p build/compiled; \
	names=$$( (find $(PACKAGES) -name '*.py' | LC_ALL=C sort; cat setup.py; echo $(OPTIMISE)) | sha256sum); \
	if [ "$$(cat build/compiled/.names 2>/dev/null)" != "$$names" ]; then \
	    rm -rf build/compiled && mkdir -p build/compiled && echo "$$names" > build/compiled/.names; fi
	cd build/compiled && rm -rf $(COPIED) && find . -path './build/*' -name '*.py' -delete
	cp -r $(COPIED) build/compiled/
	rm -rf $(COMPILED) && $(PYTHON) -m venv --without-pip $(COMPILED)
	$(BIN)/python -c "$(PURELIB)" > "$$($(COMPILED)/bin/python -c "$(PURELIB)")/dependencies.pth"
	cd build/compiled && MOTORHIL_COMPILE=1 MOTORHIL_OPTIMISE=$(OPTIMISE) ../../$(COMPILED)/bin/python -m pip install --quiet \
	    --disable-pip-version-check --no-deps --no-build-isolation --ignore-installed .

test-compiled: compiled  ## the tests again, against the compiled cores
	rm -rf build/tests && mkdir -p build/tests && cp -r tests pyproject.toml build/tests/
	cd build/tests && MOTORHIL_COMPILED=1 MOTORHIL_CHECKOUT=$(CURDIR) \
	    MOTORHIL_SHARED=$${MOTORHIL_SHARED:-$(CURDIR)/../shared} ../../$(COMPILED)/bin/python -m pytest $(TESTS)

clean:
	rm -rf $(VENV) .venv-compiled build out *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis
