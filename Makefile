# `make help` lists the targets. Each sets up .venv by itself; the second call finds it ready.

VENV := .venv
BIN := $(VENV)/bin
OUT ?= demo
CLIENT := src/twofold/html/client
PYTEST_ARGS ?=
SOURCES := src tests docs/hooks $(wildcard benchmarks)
# Two processes of one thread each take the tests in about half the time of one process of two threads.
FIRST_HALF := $(addprefix tests/,capture check cli html prepare report reproduce studio training viewer)

# The theme advertises its successor at every build.
export NO_MKDOCS_2_WARNING := true

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help demo test test-all checks pytest pytest-first pytest-second docs format benchmarks gpu-bundle web-tools vendor clean

help: ## This list
	@sed -n 's/^\([a-z-]*\):.*## /  make \1\t/p' $(MAKEFILE_LIST) | expand -t 20

demo: $(VENV)/.compiled ## Generate a synthetic subject, train an avatar, show it: demo/report.html (a few minutes)
	$(BIN)/twofold demo --out $(OUT)

test: checks pytest docs ## Everything that has to hold before a change lands

test-all: checks ## The same, with the tests that take minutes
	$(BIN)/python -m pytest -m "" $(PYTEST_ARGS)
	$(MAKE) docs

checks: $(VENV)/.ready-all ## Style, spelling, layers, types
	$(BIN)/ruff check $(SOURCES)
	$(BIN)/ruff format --check $(SOURCES)
	$(BIN)/codespell
	$(BIN)/lint-imports
	$(BIN)/pyright

pytest: $(VENV)/.ready-all ## The tests alone, in two processes (PYTEST_ARGS="tests/field -x" to choose, in one)
ifeq ($(strip $(PYTEST_ARGS)),)
	OMP_NUM_THREADS=1 $(MAKE) --no-print-directory --jobs=2 --output-sync=line pytest-first pytest-second
else
	$(BIN)/python -m pytest $(PYTEST_ARGS)
endif

pytest-first:
	$(BIN)/python -m pytest $(FIRST_HALF)

pytest-second:
	$(BIN)/python -m pytest tests $(addprefix --ignore=,$(FIRST_HALF))

docs: $(VENV)/.ready-all ## Build the documentation into site/, strictly
	$(BIN)/mkdocs build --strict --quiet

format: $(VENV)/.ready-all ## Repair what ruff can repair
	$(BIN)/ruff check --fix $(SOURCES)
	$(BIN)/ruff format $(SOURCES)

benchmarks: $(VENV)/.ready-studio ## Measure speed, beside the reference form, on one thread and on all (an hour)
	$(BIN)/python -m benchmarks

gpu-bundle: $(VENV)/.ready-studio ## What a machine with a GPU and no network needs, in gpu-bundle/ (CAPTURE=folder to choose)
	$(BIN)/python -m benchmarks.gpu_bundle gpu-bundle $(if $(CAPTURE),--capture $(CAPTURE))

web-tools: ## What the tests in Node and Chromium need (Node and Chromium themselves come from your system)
	npm ci --no-audit --no-fund --prefix tests/web

vendor: ## Bundle the report's script (three.js and html/client) anew from npm into src/twofold/html/vendor
	npm ci --no-audit --no-fund --ignore-scripts --prefix $(CLIENT)
	cd $(CLIENT) && node build.mjs

clean: ## Remove what the targets made, .venv included
	rm -rf $(VENV) site dist build .pytest_cache .ruff_cache .import_linter_cache .hypothesis
	find src tests docs -name __pycache__ -type d -prune -exec rm -rf {} +

$(VENV)/.ready-studio: pyproject.toml constraints.txt | $(VENV)/.made
	@echo "Setting up $(VENV): downloads some 500 MB, once."
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[studio,export]'
	@touch $@

$(VENV)/.ready-all: pyproject.toml constraints.txt | $(VENV)/.made
	@echo "Setting up $(VENV) with all tools: downloads some 900 MB, once."
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[studio,prepare,export,viewer,data,test,docs,dev]'
	@touch $@ $(VENV)/.ready-studio

# Loops are compiled for the processor at hand when they are first called, and kept. A person of a few pixels calls all.
$(VENV)/.compiled: $(VENV)/.ready-studio
	@echo "Compiling for this processor: a minute or two, once."
	@folder=$$(mktemp -d) && trap 'rm -rf "$$folder"' EXIT && { \
		$(BIN)/twofold studio $$folder/person --size 64 --frames 12 --cameras 2 && \
		$(BIN)/twofold train $$folder/person --out $$folder/run --steps 4 && \
		$(BIN)/twofold evaluate $$folder/run --max-images 1 --max-meshes 1 && \
		$(BIN)/twofold export $$folder/run --format glb --faces 2000 && \
		$(BIN)/twofold render $$folder/run --mesh; \
	} >$$folder/log 2>&1 || { cat $$folder/log >&2; exit 1; }
	@touch $@

$(VENV)/.made:
	@python=; for name in python3.11 python3.12 python3.10 python3 python; do \
		if "$$name" -c 'import sys; sys.exit(not (3, 10) <= sys.version_info < (3, 13))' 2>/dev/null; \
		then python=$$name; break; fi; \
	done; \
	if [ -z "$$python" ]; then \
		echo "twofold needs Python 3.10, 3.11 or 3.12 on the PATH, and found none; install one and try again." >&2; exit 2; \
	fi; \
	"$$python" -m venv --clear $(VENV) || { \
		echo "$$python could not make $(VENV); on Debian and Ubuntu install its venv package first." >&2; exit 2; }
	@touch $@
