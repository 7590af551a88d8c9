# The entry point of users and of CI. `make` alone lists the targets.
SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help
MAKEFLAGS += --no-print-directory

PYTHON ?=
WITH_TORCH ?= 0
PYTEST_ARGS ?=
DEMO_DIR ?= dataset/demo
DEMO_RESULTS ?= results/demo
SMOKE_RESULTS ?= results/feeding_smoke
BIN := .venv/bin
ifeq ($(shell uname),Linux)
export MUJOCO_GL ?= egl
endif

.PHONY: help demo smoke test test-fast test-slow check docs format setup opengl wheelhouse clean

help: ## this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-11s %s\n", $$1, $$2}' $(MAKEFILE_LIST)
	@echo "Options: PYTHON=python3.12 (makes .venv with it), MUJOCO_GL=egl|osmesa|glfw, PYTEST_ARGS='-k name'"

demo: setup opengl ## five scripted episodes, a preview video, three trained policies compared, and a picture of all tasks (5 min)
	$(BIN)/python bin/Rollout.py FeedingEnv --scripted --expert servo --motion dyskinetic --cameras none \
	  --num_episodes 5 --out $(DEMO_DIR)
	$(BIN)/python bin/Dataset.py verify $(DEMO_DIR)
	$(BIN)/python bin/Benchmark.py demo --num_episodes 20 --reference shipped_current --out $(DEMO_RESULTS)
	rm -f $(DEMO_RESULTS)/tasks.png && $(BIN)/python bin/Tasks.py --picture $(DEMO_RESULTS)/tasks.png
	@echo "Preview video: $$(ls $(DEMO_DIR)/*.mp4)"
	@echo "Report: $(DEMO_RESULTS)/report.html"
	@echo "Picture of all tasks: $(DEMO_RESULTS)/tasks.png"

smoke: setup opengl ## a benchmark in miniature, trainings included (3 minutes); part of what CI runs
	$(BIN)/python bin/Benchmark.py feeding --preset smoke --out $(SMOKE_RESULTS)

test: setup opengl ## every test but the slow ones (10 minutes on two cores)
	$(BIN)/python -m pytest -n 2 -m "not slow" $(PYTEST_ARGS)

test-fast: export MUJOCO_GL := disabled # so that a test that draws after all is found out
test-fast: setup ## the tests that need no OpenGL (under a minute)
	$(BIN)/python -m pytest -n 2 -m "not slow and not long and not gl" $(PYTEST_ARGS)

test-slow: setup opengl ## the tests that take minutes: a Ray cluster, units that are killed
	$(BIN)/python -m pytest -m slow $(PYTEST_ARGS)

check: setup ## format, lint, types
	$(BIN)/ruff format --check
	$(BIN)/ruff check
	$(BIN)/pyright

docs: export NO_MKDOCS_2_WARNING=1
docs: setup ## the documentation as a site in site/, every link checked; opens without a network
	$(BIN)/python -m pip install --disable-pip-version-check -q -c constraints.txt -e '.[docs]'
	$(BIN)/python -m mkdocs build --strict
	@echo "Start page: site/start.html"

format: setup ## format the code and fix what the linter can
	$(BIN)/ruff format
	$(BIN)/ruff check --fix

setup: ## .venv with the pinned packages (every target does this by itself)
	@.ci/setup $(PYTHON)

opengl: setup
	@$(BIN)/python robo_manip_baselines/envs/mujoco/cell/opengl.py --install

# PYTHON=3.12 is the Python of the machine that the wheels are for; .venv is left as it is.
wheelhouse: ## all wheels for a machine without network: make wheelhouse PYTHON=3.12 [WITH_TORCH=1]
	@.ci/setup
	$(BIN)/python .ci/wheelhouse.py --python "$(or $(PYTHON),3.12)" $(if $(filter 1,$(WITH_TORCH)),--with_torch)

clean: ## remove what the other targets made, datasets and results excepted
	rm -rf .venv wheelhouse build dist site *.egg-info .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -not -path './.git/*' -prune -exec rm -rf {} +
