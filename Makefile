# `make demo`, `make test` and `make test-all` need Python >= 3.11, make and a package index; nothing else.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
DEMO_DIR ?= demo
PYTEST_ARGS ?=
# Part of the slow suite: 2/5 is the second of five shares.
SHARE ?= 1/1

.DEFAULT_GOAL := help
.PHONY: help demo test test-all lint types checks unit slow docs wheel-check newest bench clean

help:
	@echo "make demo   install into .venv; an effect hidden in flats, found, and templates with it (a few minutes)"
	@echo "make test   install into .venv with the test tools; lint, types, wheel and the quick tests"
	@echo "make test-all  the same, then the slow tests"
	@echo "make docs   the documentation as HTML in doc/_build, every warning an error"
	@echo "make newest a smoke run with the newest packages, PYTHONS='python3.11 python3.12 python3.13'"
	@echo "make bench  speed beside the peers, on the same work, in one run"
	@echo "make clean  remove .venv, demo output and caches"

$(VENV)/.ready-run: pyproject.toml constraints/*.txt scripts/set_up.sh
	@PYTHON="$(PYTHON)" VENV="$(VENV)" bash scripts/set_up.sh run

$(VENV)/.ready-docs: pyproject.toml constraints/*.txt scripts/set_up.sh
	@PYTHON="$(PYTHON)" VENV="$(VENV)" bash scripts/set_up.sh docs

$(VENV)/.ready-test: pyproject.toml constraints/*.txt scripts/set_up.sh
	@PYTHON="$(PYTHON)" VENV="$(VENV)" bash scripts/set_up.sh test

demo: $(VENV)/.ready-run
	@$(BIN)/fringe-sim demo --out "$(DEMO_DIR)"

lint: $(VENV)/.ready-test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/.ready-test
	$(BIN)/mypy

# Two workers share the processors: threads of one that wait by spinning would keep the other from them.
PYTEST = OMP_WAIT_POLICY=passive OPENBLAS_NUM_THREADS=1 $(BIN)/pytest -n 2 --dist worksteal --durations=10

unit: $(VENV)/.ready-test
	$(PYTEST) -m "not slow" $(PYTEST_ARGS)

slow: $(VENV)/.ready-test
	$(PYTEST) -m slow --share=$(SHARE) $(PYTEST_ARGS)

docs: $(VENV)/.ready-docs
	$(BIN)/python -m sphinx -b html -W --keep-going -q doc doc/_build
	@echo "documentation: doc/_build/index.html"

wheel-check: $(VENV)/.ready-test
	BIN="$(BIN)" bash scripts/check_wheel.sh

# Two jobs at once: while types and wheel are checked in one process, tests take what is left of the processors.
test: lint
	@$(MAKE) -j 2 checks unit

checks: types
	@$(MAKE) wheel-check

test-all: test
	@$(MAKE) slow

# Pythons for `make newest`, which takes the newest packages instead of the pinned ones.
PYTHONS ?= $(PYTHON)
newest:
	bash scripts/check_newest.sh $(PYTHONS)

bench: $(VENV)/.ready-test
	$(BIN)/python -m benchmarks

clean:
	rm -rf $(VENV) $(DEMO_DIR) doc/_build build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
