# `make demo` and `make test` need Python >= 3.11, make and a package index; nothing else.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
DEMO_DIR ?= demo
PYTEST_ARGS ?=

.DEFAULT_GOAL := help
.PHONY: help demo test lint types unit docs wheel-check bench clean

help:
	@echo "make demo   install into .venv and run the whole chain on the built-in sensor (a few minutes)"
	@echo "make test   install into .venv with the test tools and run the whole test suite"
	@echo "make docs   the documentation as HTML in doc/_build, every warning an error"
	@echo "make bench  speed beside the peers, on the same work, in one run"
	@echo "make clean  remove .venv, demo output and caches"

$(VENV)/.ready-run: pyproject.toml constraints/*.txt scripts/set_up.sh
	@PYTHON="$(PYTHON)" VENV="$(VENV)" bash scripts/set_up.sh run

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
unit: $(VENV)/.ready-test
	OMP_WAIT_POLICY=passive OPENBLAS_NUM_THREADS=1 $(BIN)/pytest -n 2 --dist worksteal --durations=40 --durations-min=20 $(PYTEST_ARGS)

docs: $(VENV)/.ready-test
	$(BIN)/python -m sphinx -b html -W --keep-going -q doc doc/_build
	@echo "documentation: doc/_build/index.html"

wheel-check: $(VENV)/.ready-test
	BIN="$(BIN)" bash scripts/check_wheel.sh

test: lint types wheel-check unit

bench: $(VENV)/.ready-test
	$(BIN)/python -m benchmarks

clean:
	rm -rf $(VENV) $(DEMO_DIR) doc/_build build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
