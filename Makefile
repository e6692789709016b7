# make run, make test: need Python 3.11 or newer with venv, nothing else.
PYTHON ?= python3
BIN := .venv/bin
INSTALL := $(BIN)/pip install --quiet --disable-pip-version-check --editable

COMPOSE = $(shell docker compose version >/dev/null 2>&1 && echo docker compose || echo docker-compose)
LOCK = .venv/lock/bin/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes \
	--no-annotate --custom-compile-command "make lock"

.PHONY: run test check bench slow references docker lock clean

run: .venv/usable
	$(BIN)/maniple run scenarios/paper-simulation-1.toml --speed 3

test: .venv/installed
	$(BIN)/pytest

slow: .venv/installed
	$(BIN)/pytest -m slow

check: .venv/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# The recordings that the project's scenes are compared with: shows what changed, then replaces them.
references: .venv/installed
	$(BIN)/python -m tests.references.scenes

bench: .venv/installed
	$(BIN)/python -m benchmarks

# The platoon in containers; the recording is yours.
docker:
	$(COMPOSE) build router
	MANIPLE_USER=$$(id -u):$$(id -g) $(COMPOSE) up

# Newer versions of what the image holds.
lock: .venv/installed
	$(PYTHON) -m venv .venv/lock
	.venv/lock/bin/pip install --quiet --disable-pip-version-check uv
	$(LOCK) --upgrade pyproject.toml --output-file deploy/requirements.txt
	echo hatchling | $(LOCK) --upgrade - --output-file deploy/requirements-build.txt

.venv/usable: pyproject.toml
	$(PYTHON) -m venv .venv
	$(INSTALL) '.[report,planning,sweep,export,mavlink,ros2]'
	touch $@

# What the tests need besides is large: viewers, other readers.
.venv/installed: .venv/usable
	$(INSTALL) '.[dev]'
	touch $@

clean:
	rm -rf .venv build dist .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
