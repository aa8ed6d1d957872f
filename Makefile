# One target per chore. Everything runs in .venv, which the first target that needs it makes.
PYTHON ?= python3
BIN := .venv/bin
DATASET ?=
OUT ?= runs
WORKERS ?= 1
PUBLISH ?=
STAMP := .venv/.installed
DOCS_STAMP := .venv/.docs-installed
CPUS ?=
# Errors only: setuptools warns of every editable installation. Python compiles what it imports; to compile every
# file of every package takes longer than to install them.
INSTALL := $(BIN)/python -m pip install -qq --no-compile --disable-pip-version-check --constraint constraints.txt
# Two test processes on two cores: one thread each.
ONE_THREAD := OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1
PYTEST := $(ONE_THREAD) $(BIN)/python -m pytest -n 2 --dist worksteal

.PHONY: help setup demo trials gap zoo docs test test-fast test-cpus check check-all format release clean

help:              ## list the targets
	@grep -hE '^[a-z-]+: .*##' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## /\1	/' | expand -t 14

setup: $(STAMP)    ## make the environment, and show that it works
	$(BIN)/litho-models zoo list
	@echo "it works; next: make demo, or . .venv/bin/activate and litho-design first"

# The pip of the constraints first: the one that comes with Python 3.11 takes three times as long to choose.
$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(INSTALL) --upgrade pip
	$(INSTALL) --editable '.[dev]'
	@touch $@

demo: $(STAMP)     ## run the whole path: make demo, or make demo DATASET=neural-lithography
	$(BIN)/python -m examples.demo --out $(OUT) $(if $(DATASET),--dataset $(DATASET))

trials: $(STAMP)   ## blind trials of the closed loop: make trials WORKERS=2, PUBLISH=1 writes them into docs/
	$(BIN)/python -m benchmarks.blind_trials --out $(OUT)/blind-trials --workers $(WORKERS) $(if $(DASK),--dask $(DASK)) $(if $(PUBLISH),--publish)

gap: $(STAMP)      ## the design-to-manufacturing gap at full size, hours: make gap WORKERS=2 [CORRECTED=DIR] [PUBLISH=1]
	$(BIN)/python -m benchmarks.gap --out $(OUT)/gap --workers $(WORKERS) $(if $(DASK),--dask $(DASK)) $(if $(CORRECTED),--corrected $(CORRECTED)) \
		$(if $(PUBLISH),--publish)

zoo: $(STAMP)      ## train the models that ship with the package, an hour: make zoo, or make zoo MODELS=pbl,fno
	$(BIN)/python -m benchmarks.zoo $(OUT)/zoo $(if $(MODELS),--models $(MODELS))

docs: $(DOCS_STAMP) ## build the site of the documentation into runs/site; a broken link is an error
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict
	@echo "look at it: $(BIN)/python -m http.server --directory runs/site, then http://localhost:8000"

$(DOCS_STAMP): $(STAMP)
	$(INSTALL) --editable '.[docs]'
	@touch $@

test: $(STAMP)     ## pass all tests but the longest; the report is runs/tests/report.xml
	$(PYTEST) -m "not long" --durations 15 --junitxml $(OUT)/tests/report.xml
	@echo "test report: $(OUT)/tests/report.xml"

test-fast: $(STAMP) ## pass the tests that take seconds
	$(PYTEST) -m "not slow and not long"

test-cpus: $(STAMP) ## pass the tests of numerics as older processors too: make test-cpus, or make test-cpus CPUS="avx2"
	$(ONE_THREAD) $(BIN)/python tests/processors.py $(CPUS)

check: $(STAMP)    ## style and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

check-all: check   ## what is too long for CI, hours: all tests as they are and as older processors
	$(ONE_THREAD) $(BIN)/python tests/processors.py --all $(CPUS)

format: $(STAMP)   ## bring the code into the common style
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

release: $(STAMP)  ## check, test, build, try the wheel in empty environments, tag the version
	.ci/release

clean:             ## remove the environment and the caches, keep results
	rm -rf .venv .pytest_cache .mypy_cache .ruff_cache *.egg-info
