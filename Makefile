# Every target makes .venv first if it is missing or older than what it was made from.

PYTHON ?= python3
TASK ?= walker-stand
RUN_DIR ?= runs/$(TASK)
JOBS ?= 3
# Two threads make a compiled run a quarter to two fifths faster where two cores are idle (docs/results.md).
THREADS ?= $(shell $(PYTHON) -c "import os; print(min(2, os.cpu_count() or 1))")
ARGS ?=
PORT ?= 8000

VENV := .venv
READY := $(VENV)/.ready
DOCS_READY := $(VENV)/.docs-ready
# pip compiles on one core and takes as long again as for the rest; files that were written for other versions of Python
# do not compile, nor are they imported. The packages' own tests, a sixth of it all, are not imported either.
COMPILE = $(VENV)/bin/python -m compileall -qq -j 0 -x '/tests?/' $(VENV)/lib || true
# HumanoidBench simulates what it was published with only on an older MuJoCo, so it has an environment of its own.
HUMANOID_BENCH ?=
HUMANOID_REPOSITORY := https://github.com/carlosferrazza/humanoid-bench
HUMANOID_COMMIT := 791405f5eacf879adbc99105adb3fee73f5a49fc
HUMANOID_VENV := .venv-humanoidbench
# What was typed, for what to type next.
SAME_RUN = $(if $(filter command line,$(origin RUN_DIR)), RUN_DIR="$(RUN_DIR)",$(if $(filter command line,$(origin TASK)), TASK=$(TASK)))
# A run that goes on has its own settings: only what was typed is named.
TYPED = $(if $(filter command line,$(origin $1)),$2)
GOES_ON = $(if $(filter resume=true resume=auto resume=weights,$(ARGS)),$(shell test -e "$(RUN_DIR)/config.yaml" && echo yes))
OF_RUN = $(call TYPED,TASK,task=$(TASK)) $(call TYPED,THREADS,threads=$(THREADS))
OF_NEW_RUN = task=$(TASK) preset=cpu threads=$(THREADS) seed=1 total_env_steps=20000 eval_every=5000 eval_episodes=5

.DEFAULT_GOAL := help
.PHONY: help train watch report test lint bench docs docs-serve humanoidbench clean

help:
	@echo "make train   train on a CPU in minutes (TASK=walker-stand, RUN_DIR=runs/TASK, ARGS=\"more settings\")"
	@echo "make watch   film the agent of RUN_DIR into RUN_DIR/film.mp4"
	@echo "make report  curves and tables of RUN_DIR beside published baselines"
	@echo "make test    run the tests and the examples in docstrings, JOBS=3 files at a time (ARGS=\"pytest options\")"
	@echo "make lint    check style, format and types, as the commit hooks and CI do"
	@echo "make bench   run the benchmarks (ARGS=\"pytest options\")"
	@echo "make docs    build the site into build/docs/html: tutorials run, links and names are checked"
	@echo "make docs-serve   show it on http://127.0.0.1:PORT, PORT=8000"
	@echo "make humanoidbench   make $(HUMANOID_VENV), which simulates HumanoidBench (HUMANOID_BENCH=path of a clone)"
	@echo "make clean   remove the environments, caches and build output; runs/ stays"
	@echo "All need Python 3.11 or 3.12 with venv; another one than python3: make test PYTHON=python3.12"

# The command then speaks of RUN_DIR and ARGS, as they were typed here.
train: export TORCHRL_ETDMPC_MAKE = make train$(SAME_RUN)
train: $(READY)
	@echo "$(if $(GOES_ON),the run in $(RUN_DIR) goes on,$(TASK) learns on this CPU, in some minutes); Ctrl-C stops and saves"
	@$(VENV)/bin/python examples/train_dmc.py $(if $(GOES_ON),$(OF_RUN),$(OF_NEW_RUN)) run_dir="$(RUN_DIR)" $(ARGS)
	@echo 'the curve:        $(RUN_DIR)/curve.png'
	@echo 'a film of it:     make watch$(SAME_RUN)'
	@echo 'a report:         make report$(SAME_RUN)'
	@echo 'train on:  make train$(SAME_RUN) ARGS="resume=true total_env_steps=50000"'
	@echo 'another task:     make train TASK=cup-catch'
	@echo 'all the tasks:    $(VENV)/bin/python examples/train.py task=list'
	@echo 'all settings:     $(VENV)/bin/python examples/train.py --help'

watch: $(READY)
	@test -n "$(findstring checkpoint=,$(ARGS))" -o -f "$(RUN_DIR)/checkpoints/best.pt" || { echo 'error: $(RUN_DIR) holds no trained agent; run make train$(SAME_RUN) first' >&2; exit 1; }
	@$(VENV)/bin/python examples/evaluate.py checkpoint="$(RUN_DIR)/checkpoints/best.pt" episodes=1 video="$(RUN_DIR)/film.mp4" $(ARGS)

report: $(READY)
	@test -d "$(RUN_DIR)" || { echo 'error: there is no $(RUN_DIR); run make train$(SAME_RUN) first' >&2; exit 1; }
	@$(VENV)/bin/python examples/report.py "$(RUN_DIR)" --out "$(RUN_DIR)/report" $(ARGS)

# In the order of their names: the files with few tests, which would otherwise come last, take longest.
# A test that hangs for a quarter of an hour ends its process with a traceback; a second one ends all.
test: HANGS := -o faulthandler_timeout=900 -o faulthandler_exit_on_timeout=true --max-worker-restart=1
test: export MUJOCO_GL ?= disable
test: export OMP_NUM_THREADS ?= 1
test: $(READY)
	@$(VENV)/bin/python -m pytest -n $(JOBS) --dist loadfile --no-loadscope-reorder $(HANGS) $(ARGS)

lint: export PYRIGHT_PYTHON_IGNORE_WARNINGS ?= 1# it would ask the network for newer versions of itself
lint: $(READY)
	@$(VENV)/bin/ruff check
	@$(VENV)/bin/ruff format --check
	@$(VENV)/bin/pyright
	@$(VENV)/bin/pyright -p benchmarks

bench: $(READY)
	@if [ -d benchmarks ]; then $(VENV)/bin/python -m pytest benchmarks --benchmark-only $(ARGS); \
	else echo "error: there is no benchmarks/ here; run make bench in a full checkout" >&2; exit 1; fi

# A warning is an error; the walk through the built pages is left out, and says so, where there is no Chromium.
docs: export MUJOCO_GL ?= disable
docs: export OMP_NUM_THREADS ?= 1
docs: $(DOCS_READY)
	@$(VENV)/bin/python -m sphinx -q -W --keep-going -n -c docs -d build/docs/doctrees . build/docs/html $(ARGS)
	@$(VENV)/bin/python docs/check_site.py build/docs/html
	@echo 'the site: build/docs/html/index.html, or: make docs-serve'

docs-serve: $(READY)
	@test -f build/docs/html/index.html || { echo "error: there is no site yet; run make docs" >&2; exit 1; }
	@echo "http://127.0.0.1:$(PORT), Ctrl-C ends it"
	@$(VENV)/bin/python -m http.server --bind 127.0.0.1 --directory build/docs/html $(PORT)

$(DOCS_READY): requirements-docs.txt $(READY)
	@echo "installing what builds the documentation"
	@$(VENV)/bin/python -m pip install -qq --disable-pip-version-check --no-compile -r requirements-docs.txt
	@$(COMPILE)
	@touch $@

# The mark is written last, so that an interrupted installation starts over; and it starts from nothing, because
# packages that share files (mujoco 3 and 4) cannot be replaced in place.
$(READY): requirements-pins.txt pyproject.toml
	@command -v $(PYTHON) >/dev/null 2>&1 || \
		{ echo "error: $(PYTHON) not found; install Python 3.11 or 3.12, or: make PYTHON=/path/to/python" >&2; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 12))' || \
		{ echo "error: $(PYTHON) is $$($(PYTHON) -V 2>&1), but 3.11 or 3.12 is needed; choose one: make PYTHON=python3.12" >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || \
		{ echo "error: $(PYTHON) has no venv module; on Debian: apt-get install python3-venv" >&2; exit 1; }
	@echo "creating $(VENV)"
	@rm -rf $(VENV)
	@$(PYTHON) -m venv $(VENV)
	@echo "installing pinned dependencies (about 1.6 GB, more if torch brings CUDA)"
	@$(VENV)/bin/python -m pip install -qq --disable-pip-version-check --no-compile -r requirements-pins.txt
	@$(COMPILE)
	@echo "installing torchrl_etdmpc in editable mode"
	@$(VENV)/bin/python -m pip install -qq --disable-pip-version-check --no-deps -e .
	@touch $@

humanoidbench: requirements-humanoidbench.txt
	@echo "creating $(HUMANOID_VENV), with mujoco 3.1.6 and numpy below 2"
	@rm -rf $(HUMANOID_VENV)
	@$(PYTHON) -m venv $(HUMANOID_VENV)
	@echo "installing pinned dependencies (about 1.6 GB, more if torch brings CUDA)"
	@$(HUMANOID_VENV)/bin/python -m pip install -qq --disable-pip-version-check -r requirements-humanoidbench.txt
	@if [ -z "$(HUMANOID_BENCH)" ]; then \
		echo "cloning $(HUMANOID_REPOSITORY) at $(HUMANOID_COMMIT)"; \
		git clone -q $(HUMANOID_REPOSITORY) $(HUMANOID_VENV)/humanoid-bench && \
		git -C $(HUMANOID_VENV)/humanoid-bench checkout -q $(HUMANOID_COMMIT); \
	fi
	@echo "installing humanoid_bench and torchrl_etdmpc in editable mode, without what they ask for"
	@$(HUMANOID_VENV)/bin/python -m pip install -qq --disable-pip-version-check --no-deps \
		-e "$(or $(HUMANOID_BENCH),$(HUMANOID_VENV)/humanoid-bench)" -e .
	@echo 'train there: $(HUMANOID_VENV)/bin/python examples/train.py task=h1hand-walk preset=humanoidbench'
	@echo 'its tests:   $(HUMANOID_VENV)/bin/python -m pytest tests/envs/test_humanoid_bench.py'

clean:
	@rm -rf $(VENV) $(HUMANOID_VENV) build dist docs/generated docs/gallery sg_execution_times.rst .benchmarks .hypothesis .pytest_cache .ruff_cache
	@find . -path ./runs -prune -o \( -name __pycache__ -o -name '*.egg-info' \) -type d -prune -exec rm -rf {} +
