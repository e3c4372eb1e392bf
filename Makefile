# Everything a fresh machine with Python 3.11 or newer and make needs.
#   make calibrate   set up, and calibrate the paper's Experiment 2
#   make test        set up with the test tools, and run all checks that need Python alone
#   make acceptance  the wheel, commands of the pages, pages in a browser, exports in LinuxCNC
#   make benchmarks  ratios of processor times
#   make smoke       a few tests on other Pythons and with the lowest versions of dependencies
#   make docs        set up with the tools for pages, and write them to out/docs

PYTHON ?= python3
VENV ?= .venv
SESSION ?= examples/table1/experiment-2
# what `make test` runs; continuous integration runs the acceptance tests and the benchmarks, too
MARKS ?= not smoke and not acceptance
BESIDE ?=
# one more than there are cores: some tests wait for pages and processes
WORKERS ?= $(shell expr 1 + `getconf _NPROCESSORS_ONLN`)

INSTALLED = $(VENV)/.installed
TESTED = $(VENV)/.installed-test
DOCUMENTED = $(VENV)/.installed-docs

PIP = $(VENV)/bin/python -m pip install --quiet --disable-pip-version-check
# uv is several times as fast as pip, but does not read pip's settings for proxies and mirrors
define install
$(PIP) uv && $(VENV)/bin/uv pip install --quiet --python $(VENV)/bin/python --editable '$(1)' || \
	  $(PIP) --no-compile --editable '$(1)'
endef

PYTEST_IN_PARALLEL = $(VENV)/bin/python -m pytest --numprocesses $(WORKERS) --dist worksteal \
  --ignore tests/benchmarks

unexport PYTHONDONTWRITEBYTECODE  # processes of tests do not compile what others have compiled

.PHONY: calibrate test compiled suite acceptance benchmarks smoke check docs clean

calibrate: $(INSTALLED)
	$(VENV)/bin/orthocal calibrate $(SESSION) --out out/$(notdir $(SESSION))

test: $(TESTED)
	$(MAKE) --jobs 2 check suite

compiled: $(TESTED)  # the tests, once for all workers
	$(VENV)/bin/python -m pytest --collect-only -qq > $(VENV)/tests || { cat $(VENV)/tests; false; }

suite: compiled $(BESIDE)  # the checks may still run; a benchmark runs beside them alone
	$(PYTEST_IN_PARALLEL) -m "$(MARKS)"

acceptance: $(TESTED)
	$(PYTEST_IN_PARALLEL) -m acceptance

benchmarks: $(TESTED)  # in one process: they compare seconds of the processor
	$(VENV)/bin/python -m pytest tests/benchmarks

check: $(TESTED)
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy

smoke: $(TESTED)
	$(VENV)/bin/python .ci/smoke.py

docs: $(DOCUMENTED)
	$(VENV)/bin/python -m sphinx -E -W -q --keep-going -b html docs out/docs
	@echo "Wrote out/docs/index.html"

clean:
	rm -rf $(VENV) out build dist

$(VENV)/bin/python:
	$(PYTHON) -m venv $(VENV)

$(INSTALLED): pyproject.toml | $(VENV)/bin/python
	$(call install,.)
	touch $@

$(TESTED): pyproject.toml | $(VENV)/bin/python
	$(call install,.[test])
	touch $@ $(INSTALLED)

$(DOCUMENTED): pyproject.toml | $(VENV)/bin/python
	$(call install,.[docs])
	touch $@
