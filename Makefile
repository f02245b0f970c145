# For a fresh machine with Python and make: each target makes .venv and installs depthreg into it first, where needed.
PYTHON ?= python3
PYTHON311 ?= python3.11
ARGS ?=
BIN := .venv/bin

.DEFAULT_GOAL := help
.PHONY: help install blender train test integration lint docs notebooks wheel clean

help:  ## say what there is
	@awk -F ':.*## ' '/^[a-z]+:.*## / {printf "make %-12s %s\n", $$1, $$2}' $(MAKEFILE_LIST)
	@echo 'ARGS="..." goes to the command of train and test; PYTHON=... chooses the Python of a new .venv.'

install: .venv/installed  ## make .venv and install depthreg with everything that its tests need

# Changed requirements are installed into the .venv that is there. PyTorch comes first: the longest download by far.
.venv/installed: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' || \
		{ echo "make: $(PYTHON) is not a Python from 3.11 to 3.13: name one with PYTHON=..." >&2; exit 1; }
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install -c constraints.txt torch
	$(BIN)/python -m pip install -c constraints.txt -e ".[dev]"
	@touch $@

blender: .venv-blender/installed  ## make .venv-blender, which rendering=cycles needs; takes a Python 3.11

.venv-blender/installed: requirements-blender.txt
	@$(PYTHON311) -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))' || \
		{ echo "make: Blender's bpy needs Python 3.11, and $(PYTHON311) is none: name one with PYTHON311=..." >&2; exit 1; }
	$(PYTHON311) -m venv .venv-blender
	.venv-blender/bin/python -m pip install -r requirements-blender.txt
	@touch $@

train: install  ## train the quick curriculum, evaluate, draw; takes Hydra's overrides, such as ARGS="preset=paper"
	$(BIN)/depthreg train $(ARGS)

test: install  ## run the tests, a process a core
	$(BIN)/python -m pytest -n auto --ignore=tests/integration $(ARGS)

integration: install  ## run the tests on a real Ray and, where it is installed, a real Slurm; takes three minutes
	$(BIN)/python -m pip install -c constraints.txt -e ".[dev,cluster]"
	$(BIN)/python -m pytest tests/integration $(ARGS)

lint: install  ## check style and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

docs: install  ## build the documentation into site/
	$(BIN)/python -m pip install -c constraints.txt -e ".[dev,docs]"
	$(BIN)/mkdocs build --strict

notebooks: install  ## run the notebooks as they are, without keeping what they print
	$(BIN)/python -m pip install -c constraints.txt -e ".[dev,notebooks]"
	$(BIN)/python -m pytest --nbmake --nbmake-timeout=120 notebooks $(ARGS)

wheel: install  ## build the wheel and the source archive into dist/
	$(BIN)/python -m build --no-isolation

clean:  ## remove what was installed and built; runs/ stays
	rm -rf .venv .venv-blender dist site .mypy_cache .pytest_cache .ruff_cache
