# A machine with Python 3.11 and pip is all that these need. PYTHON=/path/to/python3.11 picks another interpreter.

PYTHON ?= python3.11
VENV := .venv
BIN := $(VENV)/bin
# Made anew only when the dependencies change, so that a second `make test` starts at once.
INSTALLED := $(VENV)/installed

.PHONY: demo test test-vm lint clean

demo: $(INSTALLED)
	$(BIN)/relight demo --out demo

test: $(INSTALLED)
	$(BIN)/python -m pytest -n 2

# With the kernel's own drivers, in a small virtual machine; says SKIPPED where that cannot be had. Needs no root.
test-vm: $(INSTALLED)
	$(BIN)/python tests/vm/run.py

lint: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

clean:
	rm -rf $(VENV) demo build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache

$(INSTALLED): pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --editable '.[dev]'
	touch $@
