PYTHON ?= python3
VENV ?= .venv
# Another index for wheels, for instance PyTorch's own CPU index on a machine without a GPU.
TORCH_INDEX ?=
XLA_VENV := .venv-xla
NERFBASELINES_VENV := .venv-nerfbaselines
# Hydra overrides: make train ARGS="scene=blender scene.root=data/lego"
ARGS ?=
# How many times as many cases as in make test make fuzz tries.
TIMES ?= 200
# How many tests run at a time.
WORKERS ?= 2

# Bytecode is kept, also where the environment says otherwise: else every process of the tests would compile it anew.
export PYTHONDONTWRITEBYTECODE :=
# One thread each; a worker without work takes over half of what another has left.
PYTEST := $(VENV)/bin/python -m pytest -n $(WORKERS) --dist worksteal
PIP := $(VENV)/bin/python -m pip --disable-pip-version-check
PINNED := -c constraints/torch.txt $(if $(TORCH_INDEX),--extra-index-url $(TORCH_INDEX))

# What the package needs besides torch, and what its tests need.
define XLA_NEEDS
import tomllib
project = tomllib.load(open("pyproject.toml", "rb"))["project"]
needed = [each for each in project["dependencies"] if not each.startswith("torch>")]
tests = [each for each in project["optional-dependencies"]["dev"] if each.startswith(("pytest", "hypothesis", "beartype"))]
print(*(each.replace(" ", "") for each in needed + tests))
endef
export XLA_NEEDS

.DEFAULT_GOAL := help
.PHONY: help setup train test test-all test-slow test-core test-fast test-gpu gpu-figures test-other test-xla xla test-nerfbaselines nerfbaselines check format lint types layers docs bench fuzz clean

help: ## Show this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "%-20s%s\n", $$1, $$2 }' $(MAKEFILE_LIST)

setup: $(VENV)/.ready ## Make the virtual environment and install everything that tests and contributors need
$(VENV)/.ready: $(VENV)/.usable
	@$(PIP) install -q $(PINNED) -e '.[dev]'
	@$(VENV)/bin/python -m nerf_lightning.config.exporters
	@touch $@

# What training, viewing and photographs need.
$(VENV)/.usable: pyproject.toml constraints/torch.txt
	@command -v $(PYTHON) >/dev/null || { echo "make: $(PYTHON) is missing (Debian, Ubuntu: apt install python3-venv)"; exit 2; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "make: Python 3.11 or later is needed; name one with PYTHON=python3.12"; exit 2; }
	@$(PYTHON) -m venv $(VENV) || { echo "make: python3-venv is missing (Debian, Ubuntu: apt install python3-venv)"; exit 2; }
	@echo "installing PyTorch and what nerf_lightning needs in $(VENV): a few minutes, once"
	@$(PIP) install -q $(PINNED) torch
	@$(PIP) install -q $(PINNED) -e '.[viewer,colmap]'
	@touch $@

train: $(VENV)/.usable ## Train the built-in scene, measure it and film it; ARGS="key=value ..." for Hydra overrides
	@$(VENV)/bin/nerf train experiment=quickstart $(ARGS)

test: setup ## Run the tests that are neither exhaustive nor take minutes: 5 to 7 minutes on two cores
	@$(PYTEST)

test-all: setup ## Run every test, the exhaustive ones included
	@$(PYTEST) -m ""

test-slow: setup ## Run the tests that take minutes: browsers, killed runs, kernels compiled for other machines, models on a stand-in
	@$(PYTEST) -m minutes

test-fast: setup ## Run the tests that take less than a few seconds each
	@$(PYTEST) -m "not slow and not exhaustive and not minutes"

test-core: setup ## Try the options and commands in a copy of the project without extensions; every test must be collected there
	@$(VENV)/bin/python -m pytest -m "" tests/test_without_extensions.py

test-xla: ## Run the tests of TPU training on XLA's CPU device; skipped where torch_xla cannot be installed
	@$(MAKE) --no-print-directory xla \
		|| { echo "make: test-xla is skipped: torch_xla 2.9 cannot be installed here (Linux x86-64, Python 3.11 to 3.13)"; exit 0; }; \
	PJRT_DEVICE=CPU $(XLA_VENV)/bin/python -m pytest -m xla tests/xla tests/commands/test_command_on_xla.py

test-nerfbaselines: ## Run the tests of the method in NerfBaselines; skipped where that cannot be installed
	@$(MAKE) --no-print-directory nerfbaselines \
		|| { echo "make: test-nerfbaselines is skipped: NerfBaselines cannot be installed here (see pip's message above)"; exit 0; }; \
	$(NERFBASELINES_VENV)/bin/python -m pytest nerf_lightning/extensions/nerfbaselines

nerfbaselines: $(NERFBASELINES_VENV)/.ready ## Make an environment for NerfBaselines, .venv-nerfbaselines: it wants numpy 1
$(NERFBASELINES_VENV)/.ready: pyproject.toml constraints/torch.txt
	@$(PYTHON) -m venv $(NERFBASELINES_VENV)
	$(NERFBASELINES_VENV)/bin/python -m pip --disable-pip-version-check install -q $(PINNED) torch
	$(NERFBASELINES_VENV)/bin/python -m pip --disable-pip-version-check install -q $(PINNED) -e . 'nerfbaselines>=1.2.12' \
		'pytest>=8' 'pytest-xdist>=3.5' 'hypothesis>=6.100' 'beartype>=0.18'
	@touch $@

test-gpu: setup ## Run the tests that need a GPU; skipped where there is none
	@$(VENV)/bin/python -m pytest -m gpu tests/gpu

ON_LEGO = $(VENV)/bin/nerf train trainer=gpu scene=blender scene.root=$(DATA)/lego_800 scene.background=random final.video=false
gpu-figures: setup ## Measure what docs/gpu.md lists, in a quarter of an hour; DATA=folder of fox and lego_800
	-@$(VENV)/bin/python -m pytest -m gpu tests/gpu
	-@$(VENV)/bin/nerf selftest trainer=gpu
	-@$(VENV)/bin/nerf train trainer=gpu scene=transforms scene.root=$(DATA)/fox scene.downscale=2 budget.seconds=20 final.video=false
	-@$(ON_LEGO) budget.seconds=60
	-@$(ON_LEGO) trainer.max_steps=400 debug=profile final.evaluate=false
	-@$(VENV)/bin/nerf bench trainer=gpu
	-@$(ON_LEGO) budget.seconds=300

# Machines of one kind can be tried as another: without AVX512 where there is, with bfloat16 where there is none. Only what
# trainer.precision=auto means then differs: besides commands, the tests of batch norm alone ask for it.
BFLOAT16 := $(shell grep -om1 avx512_bf16 /proc/cpuinfo 2>/dev/null)
OTHER := $(if $(BFLOAT16),ATEN_CPU_CAPABILITY=avx2 ONEDNN_MAX_CPU_ISA=AVX2,NERF_LIGHTNING_PRECISION=bf16-mixed)
OTHER_TESTS := $(addprefix tests/commands/test_,memory_plan.py trainer_settings.py train_eval_render.py processes.py fast_path.py) \
	tests/nerf/fields/test_batch_norm.py $(if $(BFLOAT16),tests/training/test_step.py $(addprefix tests/nerf/,test_matmul_precision.py \
	test_disable_autocast.py kernels fields models rendering samplers) $(addprefix --ignore=tests/nerf/kernels/test_,gpu_targets.py backends.py))
test-other: setup ## Run a part of the tests as on the other kind of CPU (bfloat16 on or off), with one thread
	@echo "as another machine: $(OTHER) OMP_NUM_THREADS=1"
	@$(OTHER) OMP_NUM_THREADS=1 $(PYTEST) $(OTHER_TESTS)

xla: $(XLA_VENV)/.ready ## Make an environment for TPUs, .venv-xla: torch 2.9 with torch_xla, 7 GB
# torch_xla's newest release is older than the torch that the package asks for, so the floors are left out here.
$(XLA_VENV)/.ready: pyproject.toml constraints/xla.txt
	@$(PYTHON) -m venv $(XLA_VENV)
	$(XLA_VENV)/bin/python -m pip --disable-pip-version-check install -q -c constraints/xla.txt torch 'torch_xla[tpu]' \
		$$($(XLA_VENV)/bin/python -c "$$XLA_NEEDS")
	$(XLA_VENV)/bin/python -m pip --disable-pip-version-check install -q --no-deps -e .
	@touch $@

check: format lint types layers test ## Everything that a change must pass

format: setup ## Format the code
	@$(VENV)/bin/ruff format .

lint: setup ## Look for mistakes
	@$(VENV)/bin/ruff check .

types: setup ## Check the types
	@$(VENV)/bin/mypy

layers: setup ## Check that dependencies point downward
	@$(VENV)/bin/lint-imports

docs: setup ## Build the documents as a site, and run their notebooks where they changed (minutes): docs/_build/index.html
	@$(VENV)/bin/python -m sphinx -q -W -b html docs docs/_build

bench: setup ## Measure training and rendering speed; ARGS="model=nerf_small"
	@$(VENV)/bin/nerf bench $(ARGS)

fuzz: setup ## Try damaged files, TIMES as many as in make test, other ones each time
	@FUZZ_TIMES=$(TIMES) $(PYTEST) tests/fuzz tests/commands/test_planted_resume.py

clean: ## Remove the virtual environment and caches (run folders stay)
	rm -rf $(VENV) $(XLA_VENV) $(NERFBASELINES_VENV) build dist docs/_build docs/jupyter_execute docs/settings.md docs/index.md docs/api.md docs/security.md docs/contributing.md docs/changelog.md docs/extension_*.md .pytest_cache .ruff_cache .mypy_cache .import_linter_cache
	find nerf_lightning tests -name __pycache__ -type d -exec rm -rf {} +
