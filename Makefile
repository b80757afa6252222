# sonarpost: `make demo` runs the whole chain, `make test` the whole test suite. Both install what they need.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
RUN_TIME := $(VENV)/.run-time
STAMP := $(VENV)/.ready
PIP := $(BIN)/python -m pip --disable-pip-version-check --quiet

.PHONY: setup demo test test-long check docs docs-serve fmt lock clean images test-compose screenshots

setup: $(STAMP)

# The locked run-time dependencies, sonarpost itself, editable, and the machine code of its codecs. Enough for `make demo`.
$(RUN_TIME): requirements.lock pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(PIP) install -r requirements.lock
	$(PIP) install --no-deps --no-build-isolation -e .
	$(BIN)/sonarpost prepare
	touch $@

# The tools for tests, checks and documentation.
$(STAMP): $(RUN_TIME) requirements-dev.lock
	$(PIP) install -r requirements.lock -r requirements-dev.lock
	touch $@

demo: $(RUN_TIME)
	$(BIN)/sonarpost demo $(ARGS)

# Three workers: many tests wait for processes. Order and assignment to workers: tests/conftest.py.
test: setup
	$(BIN)/python -m pytest --numprocesses 3 --dist loadfile --no-loadscope-reorder $(ARGS)

# Tests of several minutes each: long outages, random faults in all processes for SONARPOST_CHAOS_S (1800) seconds,
# SONARPOST_SOAK_CONTACTS (1200) contacts through all services.
test-long: setup
	$(BIN)/python -m pytest -m long -o faulthandler_timeout=7200 $(ARGS)

check: setup docs
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python tests/check_wheel.py

# The images of docker-compose.yml; without an image registry they are built from Debian and PyPI.
images:
	packaging/images.sh

# The whole chain in containers: build, start, inject faults, remove. Needs a container engine.
test-compose: setup
	PYTHON=$(BIN)/python packaging/test-compose.sh $(ARGS)

# The screenshots in docs/explanation/console; needs Chromium.
screenshots: setup
	$(BIN)/python packaging/screenshots.py

# The documentation site, in build/site; a broken link or an undocumented name fails the build.
docs: export NO_MKDOCS_2_WARNING = 1
docs: setup
	$(BIN)/mkdocs build --strict

docs-serve: export NO_MKDOCS_2_WARNING = 1
docs-serve: setup
	$(BIN)/mkdocs serve $(ARGS)

fmt: setup
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

# Resolve the dependencies of pyproject.toml and write the exact versions: requirements.lock for the run time and the
# build tools of an editable installation, requirements-dev.lock for tests, checks and documentation.
lock:
	rm -rf build/lock && $(PYTHON) -m venv build/lock
	build/lock/bin/python -m pip install --quiet --disable-pip-version-check . build editables hatchling
	build/lock/bin/python -m pip freeze --exclude sonarpost > requirements.lock
	build/lock/bin/python -m pip install --quiet --disable-pip-version-check -c requirements.lock '.[dev,docs]'
	build/lock/bin/python -m pip freeze --exclude sonarpost | grep -vxFf requirements.lock > requirements-dev.lock

clean:
	rm -rf $(VENV) build dist demo-out .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
