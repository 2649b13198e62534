PYTHON ?= python3
VENV ?= .venv
# Another index for wheels, for instance PyTorch's own CPU index on a machine without a GPU.
TORCH_INDEX ?=
# Hydra overrides: make train ARGS="scene=blender scene.root=data/lego"
ARGS ?=
# How long make soak lasts.
SECONDS ?= 1800

PIP := $(VENV)/bin/python -m pip --disable-pip-version-check
PINNED := -c constraints/torch.txt $(if $(TORCH_INDEX),--extra-index-url $(TORCH_INDEX))

.DEFAULT_GOAL := help
.PHONY: help setup train test test-all test-fast check format lint types layers bench soak clean

help: ## Show this list
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 12

setup: $(VENV)/.ready ## Make the virtual environment and install everything
$(VENV)/.ready: pyproject.toml constraints/torch.txt
	@command -v $(PYTHON) >/dev/null || { echo "make: $(PYTHON) is missing (Debian, Ubuntu: apt install python3-venv)"; exit 2; }
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 14))' \
		|| { echo "make: Python 3.11 to 3.13 is needed; name one with PYTHON=python3.12"; exit 2; }
	@$(PYTHON) -m venv $(VENV) || { echo "make: python3-venv is missing (Debian, Ubuntu: apt install python3-venv)"; exit 2; }
	$(PIP) install -q $(PINNED) torch
	$(PIP) install -q $(PINNED) -e '.[dev]'
	@$(VENV)/bin/python -m nerf_lightning.kernels.compile
	@touch $@

train: setup ## Train the embedded scene, measure it and film it; ARGS="key=value ..." for Hydra overrides
	@$(VENV)/bin/nerf train experiment=quickstart $(ARGS)

test: setup ## Run every test, but for those that take many minutes
	@$(VENV)/bin/python -m pytest

test-all: setup ## Run every test, the exhaustive ones included
	@$(VENV)/bin/python -m pytest -m ""

test-fast: setup ## Run the tests that take less than a few seconds each
	@$(VENV)/bin/python -m pytest -m "not slow"

check: format lint types layers test ## Everything that a change must pass

format: setup ## Format the code
	@$(VENV)/bin/ruff format .

lint: setup ## Look for mistakes
	@$(VENV)/bin/ruff check .

types: setup ## Check the types
	@$(VENV)/bin/mypy

layers: setup ## Check that dependencies point downward
	@$(VENV)/bin/lint-imports

bench: setup ## Measure training and rendering speed; ARGS="model=nerf_small"
	@$(VENV)/bin/nerf bench $(ARGS)

soak: setup ## Train, evaluate, render and resume in a loop for SECONDS; memory and open files must stay flat
	@$(VENV)/bin/python tests/soak.py $(SECONDS)

clean: ## Remove the virtual environment and caches (run folders stay)
	rm -rf $(VENV) build dist .pytest_cache .ruff_cache .mypy_cache .import_linter_cache
	find nerf_lightning tests -name __pycache__ -type d -exec rm -rf {} +
