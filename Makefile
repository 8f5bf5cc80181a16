# PLGRIM: `make env`, then `make demo`. Needs Python 3.11 or newer, make and git; everything else is installed
# into .venv from the hash-pinned locks in requirements/.
#
#   make env         the virtual environment, with compiled kernels (nothing to do the second time)
#   make demo        a whole mission in a built-in world, every service a process of its own
#   make test        the default test suite            make test-slow   the long tests too
#   make worlds      missions through the nine regression worlds, one for each complaint
#   make bench       the short form of every bench: figures printed, minutes; BENCHES="qmdp lcp-speed" for some
#   make faults      the fault suite, long tests too, then kill -9 of every service at 20 random phases; an hour
#   make soak        ten minutes of the whole live system: rates, CPU and memory against their budgets
#   make pictures    the README's pictures and animations: missions in lock-step, minutes; PICTURES="cave" for some
#   make lint        ruff, mypy, import-linter         make format      let ruff rewrite the files
#   make check       env, lint and test in a clean copy of the tree: what CI runs
#   make lock        resolve the locks anew            make clean       remove what was made here
#
# PYTHON=/path/to/python3.12 chooses the interpreter; UV=no installs with pip alone.

SHELL := /bin/bash
.ONESHELL:
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help
MAKEFLAGS += --no-print-directory

VENV := .venv
BIN := $(VENV)/bin
PYTHON ?=
UV ?= yes
LOCKS := requirements/build.txt requirements/dev.txt
SOURCES := schemas planning services plgrim tests
PYTEST_ARGS ?=

export PIP_DISABLE_PIP_VERSION_CHECK := 1
export PIP_NO_INPUT := 1
# The environment may lie on another file system than uv's cache: copy rather than warn about it.
export UV_LINK_MODE ?= copy
# Third-party maps and recordings, which the tests that need them skip visibly without.
export PLGRIM_DATA_DIR ?= $(abspath ../shared/data)

.PHONY: help venv env demo test test-slow worlds bench faults soak pictures lint format check lock clean

help:
	@sed -n '1,/^$$/s/^# \{0,1\}//p' Makefile

# Installed from exactly these locks, in exactly this folder: then there is nothing to do. A stamp by content,
# since a clone gives every file the same time stamp.
venv:
	@stamp=$$({ cat $(LOCKS) pyproject.toml; echo "$(CURDIR)"; } | git hash-object --stdin)
	if [ ! -x $(BIN)/python ] || [ "$$(cat $(VENV)/.installed 2>/dev/null)" != "$$stamp" ]; then
	  deploy/install.sh "$(VENV)" "$(PYTHON)" "$(UV)"
	  echo "$$stamp" >$(VENV)/.installed
	fi

# Compiles the kernels into the cache once for these sources (those that hold a kernel, as in planning/kernels.py),
# so that no service compiles while a mission runs.
env: venv
	@stamp=$$(grep -rlE --include='*.py' 'njit|overload' planning services | LC_ALL=C sort | xargs cat | git hash-object --stdin)
	cache="$${PLGRIM_CACHE_DIR:-$$HOME/.cache/plgrim}/numba"
	if [ ! -d "$$cache" ] || [ "$$(cat $(VENV)/.kernels 2>/dev/null)" != "$$stamp $$cache" ]; then
	  echo "env: compiling the kernels into $$cache (once for this source)"
	  $(BIN)/python -m plgrim.warmup
	  echo "$$stamp $$cache" >$(VENV)/.kernels
	fi

demo: env
	@$(BIN)/plgrim demo

test: env
	@$(BIN)/python -m pytest -m "not slow" $(PYTEST_ARGS)

test-slow: env
	@$(BIN)/python -m pytest $(PYTEST_ARGS)

worlds: env
	@$(BIN)/python -m pytest -s -q tests/worlds $(PYTEST_ARGS)

# Peers are compared where they are installed: pip install pomdp-py quantecon.
BENCHES ?=
bench: env
	@$(BIN)/python -m tests.bench $(BENCHES)

# Timed: for a machine with nothing else to do. FAULTS_ARGS="--times 1 --services irm sim" for less.
FAULTS_ARGS ?= --times 20 --speed 1
faults: env
	@$(BIN)/python -m pytest -s tests/faults --deselect tests/faults/test_kill.py::test_every_service_killed_five_times_at_random $(PYTEST_ARGS)
	$(BIN)/python -m tests.faults.kill $(FAULTS_ARGS)

# SOAK_ARGS="--minutes 2" for less.
SOAK_ARGS ?= --minutes 10
soak: env
	@$(BIN)/python -m tests.faults.soak $(SOAK_ARGS)

PICTURES ?=
pictures: env
	@$(BIN)/python -m plgrim.report.pictures $(PICTURES)

lint: venv
	@echo "lint: ruff check"; $(BIN)/ruff check $(SOURCES)
	echo "lint: ruff format --check"; $(BIN)/ruff format --check $(SOURCES)
	echo "lint: mypy --strict"; $(BIN)/mypy
	echo "lint: import contracts"; $(BIN)/lint-imports --config pyproject.toml

format: venv
	@$(BIN)/ruff check --fix $(SOURCES)
	$(BIN)/ruff format $(SOURCES)

# A copy of what git knows or would add, in a folder of its own, with its own environment and an empty kernel
# cache: what is forgotten in a commit's neighbourhood, or only installed by hand, shows here. Kept on failure.
check:
	@copy=$$(mktemp -d)
	echo "check: a clean copy in $$copy"
	git ls-files --cached --others --exclude-standard -z \
	  | while IFS= read -r -d '' file; do [ ! -e "$$file" ] || printf '%s\0' "$$file"; done \
	  | tar --null --files-from=- -cf - | tar -C "$$copy" -xf -
	PLGRIM_CACHE_DIR="$$copy/.cache" $(MAKE) -C "$$copy" env lint test
	rm -rf "$$copy"
	echo "check: passed"

# Resolved for Python 3.11 and up on every platform, from the default registry whatever this user's settings are.
# No file names a download host: the hashes alone say what may be installed.
COMPILE := $(BIN)/uv pip compile --no-config --universal --python-version 3.11 --fork-strategy fewest --generate-hashes \
  --no-header --no-emit-index-url --no-emit-find-links --quiet $(LOCK_ARGS)
lock: venv
	@echo "lock: resolving; LOCK_ARGS=--upgrade takes the newest versions"
	$(COMPILE) requirements/build.in --output-file requirements/build.txt
	$(COMPILE) pyproject.toml --output-file requirements/runtime.txt
	$(COMPILE) pyproject.toml --extra dev --constraint requirements/runtime.txt --constraint requirements/build.txt \
	  --output-file requirements/dev.txt
	if grep -nE '://|--(extra-)?index-url|--find-links' requirements/*.txt; then echo "lock: a lock names a host" >&2; exit 1; fi
	echo "lock: written; make env installs them"

clean:
	rm -rf $(VENV) .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache build dist
	find $(SOURCES) -name __pycache__ -type d -prune -exec rm -rf {} +
