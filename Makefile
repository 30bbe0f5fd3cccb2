# Each target sets up what it needs, from a bare clone.
PYTHON ?= python3.12
BIN := .venv/bin
# Processes that run tests side by side; each needs about 3 GB and, on its own, one core: make test JOBS=8.
JOBS ?= 2
PYTEST := $(BIN)/python -m pytest -n $(JOBS) --dist loadscope --no-loadscope-reorder
export HF_HUB_OFFLINE := 1
# Compiled modules are kept, whatever the shell says: importing LeRobot takes 25 s without, and tests start many processes.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: demo test test-slow lint bench pictures lock clean

demo: .venv/.ready
	@echo "demo: the twin demonstrates → recordings → dataset → checks → Rerun; a hidden effect is found. Nothing here comes from a robot."
	$(BIN)/python -m pipelines.demo

test: .venv/.ready
	@echo "test: everything but the tests marked slow (make test-slow)"
	$(PYTEST) -m "not slow"

test-slow: .venv/.ready
	$(PYTEST) -m slow

lint: .venv/.ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	PYTHONPATH=. $(BIN)/lint-imports

# make bench ONLY=ingest: one of the registered benchmarks. Rows go to bench.json and docs/benchmarks.md.
bench: .venv/.ready
	$(BIN)/python -m taccorl.benchmark $(if $(ONLY),--only=$(ONLY))

# The pictures of the README, docs/task_*.png, and the page of effects, docs/effects.md.
pictures: .venv/.ready
	$(BIN)/python -m pipelines.task_pictures
	$(BIN)/python -m pipelines.effects_page
	$(BIN)/python -m pipelines.mend_picture

# Names and versions only: no addresses, no hashes.
lock: .venv/.ready
	$(BIN)/uv pip compile pyproject.toml --group dev --python $(BIN)/python --no-annotate --no-header --upgrade -q -o requirements.lock

clean:
	rm -rf .venv outputs .pytest_cache .ruff_cache .import_linter_cache

.venv/.ready: requirements.lock pyproject.toml
	@python=$$(command -v $(PYTHON) || command -v python3); \
	$$python -c 'import sys; sys.exit(sys.version_info[:2] != (3, 12))' 2>/dev/null || { \
	  echo "Python 3.12 is needed, found: $$($$python --version 2>&1). Install it (pyenv install 3.12) or make PYTHON=/path/to/python3.12 …"; exit 1; }; \
	echo "setting up .venv with $$python (about 6 GB, most of it PyTorch's CUDA libraries; a minute or more)"; \
	$$python -m venv --clear .venv
	@$(BIN)/python -m pip install -q --disable-pip-version-check "$$(grep -E '^uv==' requirements.lock)"
	@$(BIN)/uv pip install -q --python $(BIN)/python -r requirements.lock || $(BIN)/python -m pip install -q -r requirements.lock
	@$(BIN)/uv pip install -q --python $(BIN)/python --no-deps -e . || $(BIN)/python -m pip install -q --no-deps -e .
	@touch $@
