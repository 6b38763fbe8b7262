# Two commands on a fresh machine: `make demo` and `make test`. Both make their own virtual environment.
PYTHON ?= python3
VENV ?= .venv
WORKERS ?= 2
BIN := $(VENV)/bin
PACKAGES := $(VENV)/.packages
STAMP := $(VENV)/.installed

.PHONY: help demo charts docs test tests mutants lint format types clean

help: ## what one can make
	@grep -hE '^[a-z]+:.*## ' $(MAKEFILE_LIST) | sed 's/:.*## /\t/' | expand -t 12

$(PACKAGES): pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { \
	  echo "diffuserbench needs Python 3.11 or newer; '$(PYTHON)' is $$($(PYTHON) --version 2>&1 || echo missing)."; \
	  echo "Install it (Debian: sudo apt install python3 python3-venv) or name one: make demo PYTHON=python3.12"; exit 1; }
	@$(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); \
	  echo "Could not make a virtual environment in '$(VENV)'. On Debian: sudo apt install python3-venv"; exit 1; }
	@echo "Installing diffuserbench and what it needs into $(VENV) (once; a minute or more) ..."
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -e ".[dev]"
	@touch $(PACKAGES)

$(STAMP): $(PACKAGES)
	@echo "Compiling what is compiled once, and trying it (half a minute) ..."
	@$(BIN)/diffuserbench test || echo "Installed, but not all of it works as it should: see above."
	@touch $(STAMP)

demo: $(STAMP) ## the main job on the simulated bench: calibrate, photograph, reconstruct, figure
	$(BIN)/diffuserbench demo

charts: $(STAMP) ## draw the charts of README and docs/benchmarks/charts.md anew (most of an hour; goes on where it stopped)
	$(BIN)/python benchmarks/charts.py

docs: $(STAMP) ## the site of all documentation, with search, gallery and reference: build/docs/README.html
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -e ".[docs]"
	$(BIN)/python -m sphinx -q -b html docs build/docs

test: lint types tests ## every check and every test

tests: $(STAMP) ## the tests alone, in WORKERS=2 processes of up to 2 GB
	$(BIN)/python -m pytest -n $(WORKERS) --dist worksteal --durations=40

mutants: $(STAMP) ## change the program a little again and again, and see whether a test notices (half an hour)
	$(BIN)/python -m tests.mutants

lint: $(PACKAGES) ## style, imports between the rooms
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports

types: $(PACKAGES) ## strict type check
	$(BIN)/mypy

format: $(PACKAGES) ## rewrite the source in house style
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean: ## remove the virtual environment and caches
	rm -rf $(VENV) .mypy_cache .ruff_cache .pytest_cache .import_linter_cache build *.egg-info
