# make demo      maps a rendered room by day, asks it by day and by night, writes topoloc-demo/report.html; installs what that needs
# make install   the program with all its extras and the tests' tools, into .venv, at the versions of constraints.txt
# make test      all checks: ruff, import contract, types, tests; installs into .venv only what these need
# make test-slow   the few tests that `make test` leaves out for their time: the paper made again, networks trained
# make acceptance   the commands as a user types them, on the recordings in ../shared; compares figures with benchmarks/acceptance.json
# make acceptance-quick   the part of it that takes at most three minutes
# make judge     the tables by which a change of answers is judged, beside benchmarks/judged; 60 minutes on two idle cores, goes on where it stopped
# make lint      the same without the tests; warns of figures above their budgets (tools/budgets.py)
# make docs      these pages as HTML, in docs/_build/html; a warning is an error
# make release REPOSITORY=https://github.com/OWNER/topoloc   the four distributions, in dist/, with the addresses for an index
# make clean     remove what the above made
# PYTHON=... chooses the interpreter that .venv is made with.

VENV := .venv
BIN := $(VENV)/bin
OUT := topoloc-demo
PIP := $(BIN)/python -m pip --quiet --disable-pip-version-check install --constraint constraints.txt
CANDIDATES := $(PYTHON) python3.13 python3.12 python3.11 python3
# Without a look at the network for a newer pyright; its node comes from the package index.
PYRIGHT := PYRIGHT_PYTHON_IGNORE_WARNINGS=1 $(BIN)/pyright

.PHONY: demo install test test-slow acceptance acceptance-quick judge lint kernels docs release clean
.DELETE_ON_ERROR:

demo: $(VENV)/installed-core
	@$(BIN)/topoloc demo --out $(OUT)

install: $(VENV)/installed-all

# Compiled modules are kept: a test run starts hundreds of processes.
test test-slow: export PYTHONDONTWRITEBYTECODE =

# The type checker keeps one processor busy: beside it, another compiles once what the tests' processes would each compile.
test: $(VENV)/installed-test
	@$(MAKE) --no-print-directory --jobs 2 lint kernels
	@$(BIN)/pytest --numprocesses auto --maxprocesses 4 --dist worksteal --durations 25

kernels: $(VENV)/installed-test
	@$(BIN)/python -c 'import topoloc; topoloc.warm_up()'

test-slow: $(VENV)/installed-test
	@$(BIN)/pytest -m slow

acceptance: kernels
	@$(BIN)/python benchmarks/acceptance.py

acceptance-quick: kernels
	@$(BIN)/python benchmarks/acceptance.py --quick

judge: kernels
	@$(BIN)/python benchmarks/judge.py

lint: $(VENV)/installed-test
	@$(BIN)/ruff check --no-cache --quiet
	@$(BIN)/ruff format --check --quiet || { $(BIN)/ruff format --check; exit 1; }
	@$(BIN)/lint-imports --no-logo > $(VENV)/lint-imports.txt || { cat $(VENV)/lint-imports.txt; exit 1; }
	@$(PYRIGHT)
	@$(BIN)/python tools/budgets.py

docs: $(VENV)/installed-docs
	@$(BIN)/sphinx-build --quiet --fresh-env --fail-on-warning --keep-going -d docs/_build/trees docs docs/_build/html
	@echo "docs/_build/html/index.html"

release: $(VENV)/installed-test
	@$(BIN)/python tools/release.py '$(REPOSITORY)'

# What each kind of installation brings; one that brings more has brought the others, too.
$(VENV)/installed-core: EXTRAS := [report]
$(VENV)/installed-core: BRINGS := core
$(VENV)/installed-docs: EXTRAS := [docs]
$(VENV)/installed-docs: BRINGS := core docs
$(VENV)/installed-test: EXTRAS := [test]
$(VENV)/installed-test $(VENV)/installed-all: WORKSHOP := --editable ./worlds --editable ./training --editable ./paper
$(VENV)/installed-test: BRINGS := core docs test
$(VENV)/installed-all: EXTRAS := [all,test]
$(VENV)/installed-all: BRINGS := core docs test all
$(VENV)/installed-core $(VENV)/installed-docs $(VENV)/installed-test $(VENV)/installed-all: pyproject.toml worlds/pyproject.toml training/pyproject.toml paper/pyproject.toml constraints.txt $(BIN)/python
	@echo "installing topoloc$(EXTRAS) into $(VENV) ..."
	@$(PIP) hatchling editables
	@$(PIP) --no-build-isolation --editable '.$(EXTRAS)' $(WORKSHOP)
	@touch $(BRINGS:%=$(VENV)/installed-%)

$(BIN)/python:
	@for python in $(CANDIDATES); do \
	    $$python -c 'import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1 || continue; \
	    echo "making $(VENV) with $$($$python --version) ($$python)"; \
	    $$python -m venv $(VENV) && exit 0; \
	    rm -rf $(VENV); \
	done; \
	echo "error: no Python 3.11 or later with venv and ensurepip (tried: $(strip $(CANDIDATES))); install one, or: make PYTHON=/path/to/python" >&2; \
	exit 1

clean:
	@rm -rf $(VENV) topoloc-demo build dist docs/_build .pytest_cache .ruff_cache .hypothesis .import_linter_cache
	@find . -name __pycache__ -type d -prune -exec rm -rf {} +
