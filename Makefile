# What a newcomer types. Everything runs inside .venv, which the first target that needs it makes.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
STAMP  := $(VENV)/.installed
export MPLBACKEND := Agg
# Where it is set, each of the processes that tests start would compile all of tolnet again.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test test-fast check packages bench study lock format clean help
.DEFAULT_GOAL := help

help: ## list the targets
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*##/\t/' | expand -t 11

$(STAMP): requirements/lock.txt pyproject.toml
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@echo "installing the locked dependencies into $(VENV)"
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements/lock.txt
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	@touch $@

demo: $(STAMP) ## the projectile network: problem, tolerance table, performance and certificate, in ./demo
	@$(BIN)/python scripts/demo.py demo

test: $(STAMP) ## every test at its quick size, notebooks included: some ten minutes of processor time
	@$(BIN)/python -m pytest -n 2 --dist worksteal tests
	@$(BIN)/python -m pytest -n 2 --nbmake --nbmake-timeout=900 notebooks

test-fast: $(STAMP) ## the daily loop: a part of the tests from every room, within a minute
	@$(BIN)/python -m pytest -q -n 2 --dist worksteal --fast tests

check: $(STAMP) ## style, types, import directions
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/lint-imports
	@$(BIN)/pyright

packages: $(STAMP) ## sdist and wheel: built, installed into empty environments, and run there
	@$(BIN)/python scripts/check_packages.py

bench: $(STAMP) ## speed and memory, as ratios to a named peer in the same run
	@$(BIN)/python -m benchmarks

study: $(STAMP) ## all at full size (TOLNET_STUDY=full): notebooks, tests, 10,000 altered and 460 forged certificates, mutants of the checker
	@TOLNET_STUDY=full $(BIN)/python scripts/build_notebooks.py
	@TOLNET_STUDY=full $(BIN)/python -m pytest -q -n 2 --dist worksteal tests
	@$(BIN)/python scripts/mutate_checker.py

format: $(STAMP) ## put the code into the house style
	@$(BIN)/ruff check --fix .
	@$(BIN)/ruff format .

lock: ## resolve the dependencies again
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@$(BIN)/python -m pip install --quiet uv
	@$(BIN)/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-header \
	  --all-extras --group dev pyproject.toml requirements/build.in -o requirements/lock.txt --upgrade

clean: ## remove what these targets made
	rm -rf $(VENV) demo build dist .pytest_cache .ruff_cache
