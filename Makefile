# Every rule runs from a fresh clone; `make` alone lists them.
VENV := .venv
BIN := $(VENV)/bin
# CUDA=1 installs the build of PyTorch for NVIDIA GPUs, CUDA=0 the CPU's; without, the machine decides
STAMP := $(VENV)/.kerv-installed$(if $(filter-out 0,$(CUDA)),-cuda)
CODE := kerv_cli tests scripts

# One thread: the models are small, and results and timings must not depend on the number of cores.
test test-cpus: export OMP_NUM_THREADS := 1

.NOTPARALLEL:
.PHONY: help setup test test-cpus demo papers torture trials lint format release pages docs lock clean

help: ## list these rules
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-9s %s\n", $$1, $$2 }' $(firstword $(MAKEFILE_LIST))

setup: $(STAMP) ## install kerv and its tools into .venv (CUDA=1: with PyTorch for NVIDIA GPUs), and the OpenGL libraries if MuJoCo cannot draw
	@scripts/graphics.sh $(BIN)/python

$(STAMP): pyproject.toml requirements/common.txt requirements/cpu.txt requirements/cuda.txt
	@PYTHON="$(PYTHON)" CUDA="$(CUDA)" scripts/install.sh $@

# Files stay whole: their fixtures are shared. More than four processes wait for each other's rendering.
PARALLEL = -n $$($(BIN)/python -c 'import os; print(min(4, os.cpu_count() or 1))') --dist loadfile

test: lint ## check style, types and imports, then run the tests
	@$(BIN)/python -m pytest $(PARALLEL)

test-cpus: setup ## run the tests of equal bits and tokens under four kinds of CPU kernels
	@$(BIN)/python scripts/cpus.py $(PARALLEL)

demo: setup ## README's table in small: six settings, one task, about three minutes
	@echo "README's table in small: six settings decode the same three episodes in turn, about three minutes on one core"
	@$(BIN)/kerv build target grow=60m policy.target=mt10-h1 name=mt10-60m > /dev/null
	@$(BIN)/kerv sweep study=demo

papers: setup ## run the papers' study, a seed per task, about half an hour
	@$(BIN)/kerv build target grow=150m policy.target=mt10-h1 name=mt10-h1-150m > /dev/null
	@$(BIN)/kerv sweep study=papers episodes=1 study.block=1

torture: setup ## kill commands, break their disk, damage their files, at random (MINUTES=1)
	@$(BIN)/python -m pytest -s tests/reliability/torture.py

trials: setup ## kill, stop and continue sweeps and workers at random (TRIALS=200 FIRST=0)
	@$(BIN)/python tests/reliability/trials.py $${TRIALS:-200} $${FIRST:-0}

lint: setup ## check style, types, and that rooms import only what lies below
	@$(BIN)/ruff check $(CODE)
	@$(BIN)/ruff format --check $(CODE)
	@$(BIN)/mypy
	@$(BIN)/lint-imports --no-logo

format: setup ## rewrite the code in the project's style
	@$(BIN)/ruff check --fix --quiet $(CODE)
	@$(BIN)/ruff format $(CODE)

release: setup ## build the wheel and the source into dist/, and run an episode from each in an empty environment
	@scripts/release.sh $(BIN)/python

pages: setup ## fill the figures of README.md and results/README.md from results/tables
	@$(BIN)/python scripts/figures.py README.md results/README.md results/details.md

docs: setup ## build the pages as a site in build/site; a link that leads nowhere is an error
	@$(BIN)/python -c 'import zensical' 2>/dev/null || $(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[docs]'
	@$(BIN)/python scripts/docs.py

lock: setup ## write requirements/*.txt from what is installed, with the hashes of the files
	@$(BIN)/python scripts/lock.py

clean: ## remove caches and built packages; keeps .venv and results
	@rm -rf build dist .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis MUJOCO_LOG.TXT
	@find kerv_cli tests scripts conf -name __pycache__ -prune -exec rm -rf {} +
