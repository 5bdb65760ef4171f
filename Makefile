# Everything runs in .venv, which is created on first use: `make demo` in a fresh clone installs what it needs.

PYTHON ?= python3
BIN := .venv/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt

.PHONY: help demo test test-long lint docs notebooks package clean

help:
	@echo "make demo       render a small scene, attribute a metric to it, write figures to out/"
	@echo "make test       lint, then all tests but the long ones"
	@echo "make test-long  the tests that take minutes, with the counts they print"
	@echo "make lint       ruff and mypy"
	@echo "make docs       the documentation as HTML in docs/_build/; a warning is an error"
	@echo "make package    build wheel and sdist, install them in new environments, and run the demo there"
	@echo "make notebooks  run the notebooks in examples/notebooks/ and store their outputs; takes minutes"
	@echo "make clean      remove outputs and caches (not .venv)"
	@echo
	@echo "PYTHON=python3.12 chooses the Python for .venv (3.10 or newer)."

demo: .venv/.llvm
	$(BIN)/scenecaptum demo --out out
	@echo "Activate the environment first: . $(BIN)/activate"

test: lint .venv/.llvm .venv/.chromium
	$(BIN)/python -m pytest

test-long: .venv/.test .venv/.llvm
	$(BIN)/python -m pytest -m long -rP

lint: .venv/.test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

docs: .venv/.docs
	rm -rf docs/generated
	$(BIN)/sphinx-build -q -W --keep-going -b html docs docs/_build

package:
	PYTHON=$(PYTHON) scripts/check-package

notebooks: .venv/.test .venv/.llvm
	$(BIN)/python examples/notebooks/run.py

clean:
	rm -rf out docs/_build docs/generated docs/jupyter_execute build dist .mypy_cache .ruff_cache .pytest_cache src/*.egg-info
	find src tests benchmarks examples -name __pycache__ -type d -prune -exec rm -rf {} + 2>/dev/null || true

$(BIN)/python:
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10) and "scenecaptum needs Python 3.10 or newer; try make PYTHON=python3.11")'
	$(PYTHON) -m venv .venv

# Stamp files: a step runs again when its inputs have changed.
.venv/.base: pyproject.toml constraints.txt | $(BIN)/python
	@echo "Installing scenecaptum with torch and Mitsuba into .venv: once, 1.4 GB, 2 to 8 minutes."
	$(PIP) -e .
	@touch $@

.venv/.test: .venv/.base
	@echo "Installing what the tests need."
	$(PIP) -e '.[test]'
	@touch $@

.venv/.docs: .venv/.base
	$(PIP) -e '.[docs]'
	@touch $@

.venv/.llvm: .venv/.base scripts/provide-llvm
	@$(BIN)/scenecaptum doctor >/dev/null 2>&1 || scripts/provide-llvm .venv
	$(BIN)/scenecaptum doctor
	@touch $@

.venv/.chromium: .venv/.test scripts/provide-chromium
	@scripts/provide-chromium
	@touch $@
