# Each target sets up what it needs, from a bare clone. make help lists them: the text after ## of each.
PYTHON ?= python3.12
BIN := .venv/bin
# Processes that run tests side by side; each needs about 3 GB and, on its own, one core: make test JOBS=8.
JOBS ?= 2
PYTEST := $(BIN)/python -m pytest -n $(JOBS) --dist loadscope --no-loadscope-reorder
export HF_HUB_OFFLINE := 1
# Compiled modules are kept, whatever the shell says: importing LeRobot takes 25 s without, and tests start many processes.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: help demo test test-slow freeze lint bench pictures notebooks docs lock clean

demo: .venv/.ready  ## simulated demonstrations → recordings → dataset → checks → Rerun file; a hidden effect is found (the default)
	@echo "demo: simulated demonstrations → recordings → dataset → checks → Rerun; then a hidden effect is found. Nothing here comes from a robot."
	$(BIN)/python -m pipelines.demo

# Only the targets that have a description.
help:  ## this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "make %-10s %s\n", $$1, $$2 }' Makefile

test: .venv/.ready  ## all fast tests, two processes side by side (JOBS=8: eight)
	@echo "test: everything but the tests marked slow (make test-slow)"
	$(PYTEST) -m "not slow"

test-slow: .venv/.ready  ## what takes long: notebooks, browsers, training, kills, whole searches
	$(PYTEST) -m slow

freeze: .venv/.ready  ## digests of what the commands compute, for changes that must not change it (CHECK=1: compare; ONLY=touch: a part)
	$(BIN)/python tests/freeze.py $(if $(CHECK),--check) $(if $(ONLY),--only=$(ONLY))

lint: .venv/.ready  ## ruff, pyright and the order of imports
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	PYTHONPATH=. $(BIN)/lint-imports

bench: .venv/.ready  ## measure; writes bench.json and docs/benchmarks.md (ONLY=ingest: one benchmark)
	$(BIN)/python -m pipelines.benchmarks $(if $(ONLY),--only=$(ONLY))

pictures: .venv/.ready  ## draw the pictures of the README and docs/effects.md again
	$(BIN)/python -m pipelines.task_pictures
	$(BIN)/python -m pipelines.effects_page

notebooks: .venv/.ready  ## run the notebooks and store their outputs (ONLY=2: the second)
	$(BIN)/python tests/notebooks/stored_outputs.py $(ONLY)

docs: .venv/.ready  ## the documentation as a site, in outputs/docs/index.html; a broken link is an error
	$(BIN)/python -m sphinx -q -W --keep-going -c docs . outputs/docs
	@echo "outputs/docs/index.html"

# Names and versions only: no addresses, no hashes.
lock: .venv/.ready  ## newest versions that fit pyproject.toml, into requirements.lock
	$(BIN)/uv pip compile pyproject.toml --extra train --extra peft --group dev --python $(BIN)/python --no-annotate --no-header --upgrade -q -o requirements.lock

clean:  ## remove .venv, outputs and caches
	rm -rf .venv outputs .pytest_cache .ruff_cache .import_linter_cache

.venv/.ready: requirements.lock pyproject.toml
	@python=$$(command -v $(PYTHON) || command -v python3); \
	$$python -c 'import sys; sys.exit(sys.version_info[:2] != (3, 12))' 2>/dev/null || { \
	  echo "Python 3.12 is needed, found: $$($$python --version 2>&1). Install it (pyenv install 3.12) or make PYTHON=/path/to/python3.12 …"; exit 1; }; \
	echo "setting up .venv with $$python (about 6 GB, most of it PyTorch's CUDA libraries; a minute or more)"; \
	if [ -L .venv ]; then echo '.venv is a link: a set-up here would empty the environment it points to. Remove the link'; exit 1; fi; \
	$$python -m venv --clear .venv
	@$(BIN)/python -m pip install -q --disable-pip-version-check "$$(grep -E '^uv==' requirements.lock)"
	@$(BIN)/uv pip install -q --python $(BIN)/python -r requirements.lock || $(BIN)/python -m pip install -q -r requirements.lock
	@$(BIN)/uv pip install -q --python $(BIN)/python --no-deps -e . || $(BIN)/python -m pip install -q --no-deps -e .
	@touch $@
