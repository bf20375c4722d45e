# Everything starts here: each target makes .venv first, if it is missing or its lock has changed.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready

COMPILED := .venv-compiled
DOCS := .venv-docs
DIST := dist
OPTIMISE := 2
PACKAGES := motorhil
WORKERS := -n 2 --dist loadfile --no-loadscope-reorder
# These mostly wait. They run beside all others, and go before them at the processor.
WAITING := wall or vcan
WAITING_FILES = $(shell grep -rlE 'mark\.(wall|vcan)' tests --include='test_*.py')

DOCUMENTS := tests/architecture/test_docs_links.py tests/architecture/test_docs_language.py

# What was read once is not compiled or rewritten anew by each of the hundreds of programs that the
# tests start, whatever the environment says; nor does it lie among the sources.
BYTECODE := build/bytecode
test: export PYTHONDONTWRITEBYTECODE :=
test: export PYTHONPYCACHEPREFIX := $(CURDIR)/$(BYTECODE)

.PHONY: help install demo docs wheel quick test waiting-tests working-tests source-tests check style types bench bench-against fuzz mutants rule-mutants clauses golden format clean compiled build-compiled fuzz-compiled

# It takes a second, compiling a minute or more: so nobody waits for compiled cores the first time.
# What could not be built is not tried again before something has changed.
demo: $(READY)  ## the rover manoeuvre on emulated drives; writes out/demo.mcap; PURE=1 without a compiler
ifeq ($(PURE),1)
	MOTORHIL_PURE=1 $(BIN)/motorhil demo
else
	@source=$(SOURCE); \
	if $(built); then exec $(COMPILED)/bin/motorhil demo; fi; \
	MOTORHIL_PURE=1 $(BIN)/motorhil demo || exit; \
	if ! command -v $${CC:-cc} > /dev/null; then \
	    echo "pure Python cores: no C compiler here ($${CC:-cc})"; \
	elif [ "$$(cat build/.failed 2>/dev/null)" = "$$source" ]; then \
	    echo "pure Python cores: the compiled ones could not be built; make compiled tells why"; \
	else \
	    echo "That was pure Python. Now compiled cores are built, once, in a minute or two (Ctrl-C leaves it):"; \
	    if $(MAKE) --no-print-directory compiled; then rm -f build/.failed; exec $(COMPILED)/bin/motorhil demo; fi; \
	    mkdir -p build; echo "$$source" > build/.failed; echo "pure Python cores then."; \
	fi
endif

wheel: compiled  ## in dist: the sources, a wheel of pure Python, one with compiled cores for this Python
	@rm -rf build/wheel && mkdir -p build/wheel/sources && cp -rL $(COPIED) build/wheel/
	@cd build/wheel && ../../$(call HOOK,build_sdist) . > ../wheel.log 2>&1
	@tar -xzf build/wheel/*.tar.gz -C build/wheel/sources --strip-components 1  # the wheel is of what it holds
	@cd build/wheel/sources && ../../../$(call HOOK,build_wheel) .. >> ../../wheel.log 2>&1
	@mkdir -p $(DIST) && mv build/wheel/*.tar.gz build/wheel/*.whl $(DIST) && cp build/compiled/wheel/*.whl $(DIST)
	@ls $(DIST)

quick: $(READY)  ## style and tests that the changes since main can break, nearest first; QUICK="--seconds N --list"
	@$(BIN)/python -m tests.architecture.quick $(QUICK)

nightly: $(READY)  ## what repeats: Hypothesis with new seeds and many examples, stress, fuzz, all mutants, a sample by rule, a swarm
	MOTORHIL_HYPOTHESIS=nightly $(BIN)/python -m pytest $(WORKERS) --timeout 7200 -m "hypothesis or nightly"
	$(MAKE) --no-print-directory fuzz FUZZ="--seed $$(date +%s) --seconds 1800"
	$(MAKE) --no-print-directory mutants
	$(MAKE) --no-print-directory rule-mutants
	-$(MAKE) --no-print-directory rule-mutants RULES="--seed $$(date +%s)"
	$(BIN)/python -m tests.system.swarm --first $$(date +%s)

# Import contracts and documents have tests, so that these need not be checked before. What ships is
# what is tested; then the sources, with fewer random examples. Without a compiler they meet all tests.
# The cores are built beside the checks, since one processor idles while mypyc translates. Where none
# are, they are built at -O1, in half the time: they round the same, and are 5 % slower.
test: $(READY)  ## everything that must hold, on one machine, in minutes; PURE=1: the sources alone
	@if [ "$(PURE)" = 1 ] || ! command -v $${CC:-cc} > /dev/null; then cores=; else cores=compiled; fi; \
	case "$$(cat $(COMPILED)/.source 2>/dev/null)" in "" | *" 1") level=1;; *) level=$(OPTIMISE);; esac; \
	$(MAKE) --no-print-directory --jobs 2 --output-sync=line OPTIMISE=$$level $$cores types style $(BYTECODE)/.made && \
	if [ -z "$$cores" ]; then exec $(BIN)/python -m pytest $(WORKERS); fi && \
	$(MAKE) --no-print-directory --jobs 2 working-tests source-tests

waiting-tests: $(READY)
	@unset MAKEFLAGS; $(COMPILED)/bin/python -P -m pytest $(WORKERS) --cores compiled -m "$(WAITING)" \
	    $(WAITING_FILES) > build/waiting.txt 2>&1; status=$$?; echo; cat build/waiting.txt; exit $$status

working-tests: $(READY)
	@unset MAKEFLAGS; nice $(COMPILED)/bin/python -P -m pytest $(WORKERS) --cores compiled -m "not ($(WAITING))"

source-tests: waiting-tests
	@unset MAKEFLAGS; MOTORHIL_HYPOTHESIS=brief nice $(BIN)/python -m pytest $(WORKERS) --cores pure \
	    > build/sources.txt 2>&1; status=$$?; echo; cat build/sources.txt; exit $$status

check: style types  ## style, types, import contracts, links and language of the documents
	$(BIN)/lint-imports
	@$(BIN)/python -m tests.architecture.structure
	$(BIN)/python -m pytest -p no:cacheprovider $(DOCUMENTS)

style: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(READY)
	$(BIN)/mypy

# Once on a fresh clone, beside the types: otherwise each worker would compile all tests for itself.
$(BYTECODE)/.made: $(READY)
	@mkdir -p $(BYTECODE) && $(BIN)/python -m pytest -p no:cacheprovider --collect-only > $(BYTECODE)/tests.txt || \
	    { cat $(BYTECODE)/tests.txt; exit 1; }
	@touch $@

docs: $(READY) $(DOCS)/.ready  ## the documents as a site, which works from disk: build/docs/html/index.html
	$(BIN)/python -m motorhil.harness.documentation docs build/docs/source
	$(DOCS)/bin/sphinx-build -q -W --keep-going build/docs/source build/docs/html
	@echo build/docs/html/index.html

bench: $(READY)  ## figures against peers and those kept in kept.tsv; BENCH="--all", "NAME", "--keep 3"
	$(BIN)/python -m tests.benchmarks $(BENCH)

bench-against: $(READY)  ## REV, another revision, built once: what the demo, csp and the bus cost beside it
	$(BIN)/python -m tests.benchmarks.against $(REV) $(AGAINST)

fuzz: $(READY)  ## attacks on drives, hosts, files, locks, recorders, programs, memory; FUZZ="ATTACK --seed N --seconds S"
	$(BIN)/python -m tests.attack $(FUZZ)

mutants: $(READY)  ## every adaptation broken on purpose against every clause; writes the kill table
	$(BIN)/python -m tests.conformance.mutants $(MUTANTS)

rule-mutants: $(READY)  ## a sample of small changes of the sources against the clauses; RULES="--seed N --count N"
	MOTORHIL_PURE=1 PYTHONPYCACHEPREFIX=build/bytecode $(BIN)/python -m tests.conformance.mutants.by_rule $(RULES)

clauses: $(READY)  ## docs/reference/*clauses.md, every clause for adaptations and drives; api-names.md
	$(BIN)/python -m motorhil.harness.conformance.kit > docs/reference/clauses.md
	$(BIN)/python -m motorhil.harness.conformance.drives.kit > docs/reference/drive-clauses.md
	$(BIN)/python -m motorhil.harness.api_names > docs/reference/api-names.md

golden: $(READY)  ## the golden recordings again, where a rig does something else today
	$(BIN)/python -m tests.support.golden

format: $(READY)  ## formats the sources
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

install: $(READY)  ## the command motorhil, in the environment .venv
	@echo "next: . $(BIN)/activate"

# As a path: a folder motorhil in the current directory, such as the clone itself, hides no package.
$(READY): requirements.lock pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation \
	    --config-settings editable_mode=compat -e .
	touch $@

$(DOCS)/.ready: docs/requirements.lock
	$(PYTHON) -m venv $(DOCS)
	$(DOCS)/bin/python -m pip install --quiet --disable-pip-version-check --require-hashes -r docs/requirements.lock
	touch $@

# What the cores are made of. Tests that ask for less than what ships take what ships, where it is.
SOURCE = $$(find -L $(PACKAGES) setup.py pyproject.toml requirements.lock -type f ! -name '*.pyc' \
    -exec sha256sum {} + | LC_ALL=C sort | sha256sum | cut -c1-64)
built = case "$$(cat $(COMPILED)/.source 2>/dev/null)" in "$$source "[$(OPTIMISE)-3]) true;; *) false;; esac

compiled: $(READY)  ## the hot cores as C extensions; .venv/bin/motorhil takes them
	@source=$(SOURCE); proof=$$($(BIN)/python -m motorhil.compiled); \
	{ $(built) || $(MAKE) --no-print-directory build-compiled SOURCE="$$source"; } && \
	    if $(built) && [ "$$(cat $(COMPILED)/.proof 2>/dev/null)" != "$$proof" ]; then \
	    echo "$$proof" > $(COMPILED)/.proof; fi

# Built from a copy, for a .so beside the sources would hide them; with the dependencies of .venv.
# What was built before is used again, as long as the same modules are compiled in the same way.
COPIED := $(PACKAGES) pyproject.toml setup.py README.md LICENSE
PURELIB := import sysconfig; print(sysconfig.get_path('purelib'))
HOOK = $(BIN)/python -c "import sys; from setuptools import build_meta; build_meta.$(1)(sys.argv[1])"
LOG := build/compiled.log
build-compiled: SHELL := bash
build-compiled: .SHELLFLAGS := -o pipefail -c
build-compiled: $(READY)
	@mkdir -p build/compiled; \
	names=$$( (find -L $(PACKAGES) -name '*.py' | LC_ALL=C sort; cat setup.py; echo $(OPTIMISE)) | sha256sum); \
	if [ "$$(cat build/compiled/.names 2>/dev/null)" != "$$names" ]; then \
	    rm -rf build/compiled && mkdir -p build/compiled && echo "$$names" > build/compiled/.names; fi
	@cd build/compiled && rm -rf $(COPIED) wheel && find . -path './build/*' -name '*.py' -delete
	@cp -rL $(COPIED) build/compiled/
	@cd build/compiled && MOTORHIL_COMPILE=1 MOTORHIL_OPTIMISE=$(OPTIMISE) ../../$(call HOOK,build_wheel) wheel 2>&1 | \
	    tee ../../$(LOG) | sed -un '/ C files compiled$$/p' || { grep -m1 -E 'error:|Error' ../../$(LOG) >&2; \
	    echo "the compiled cores could not be built, all of it: $(LOG)" >&2; exit 1; }
	@rm -rf $(COMPILED) && $(PYTHON) -m venv --without-pip $(COMPILED)
	@$(BIN)/python -c "$(PURELIB)" > "$$($(COMPILED)/bin/python -c "$(PURELIB)")/dependencies.pth"
	@$(COMPILED)/bin/python -m pip install --quiet --disable-pip-version-check --no-deps --no-index \
	    --ignore-installed build/compiled/wheel/*.whl
	@echo "$(SOURCE) $(OPTIMISE)" > $(COMPILED)/.source

fuzz-compiled: compiled  ## the attacks against the compiled cores; FUZZ as for fuzz
	@rm -rf build/tests && mkdir -p build/tests && cp -r tests pyproject.toml build/tests/
	@cd build/tests && MOTORHIL_CHECKOUT=$(CURDIR) MOTORHIL_SHARED=$${MOTORHIL_SHARED:-$(CURDIR)/../shared} \
	    ../../$(COMPILED)/bin/python -m tests.attack $(FUZZ)

clean:  ## removes all that the other targets have made
	rm -rf $(VENV) .venv-compiled .venv-docs build dist out *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis

help:  ## lists the targets
	@sed -n 's/^\([a-z-]*\):[^#]*## \(.*\)/\1\t\2/p' Makefile | expand -t 16
