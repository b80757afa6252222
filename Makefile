# sonarpost: `make demo` runs the whole chain, `make test` the whole test suite. Both set up what they need.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
RUN_TIME := $(VENV)/.run-time
STAMP := $(VENV)/.ready
PIP := $(BIN)/python -m pip --disable-pip-version-check --quiet

.PHONY: setup demo test test-long check docs docs-serve fmt lock clean images test-compose screenshots

setup: $(STAMP)

# The locked versions of what sonarpost needs at run time, then sonarpost itself, editable. `make demo` needs no more.
$(RUN_TIME): requirements.lock pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(PIP) install -r requirements.lock
	$(PIP) install --no-deps --no-build-isolation -e .
	touch $@

# The tools for tests, checks and documentation.
$(STAMP): $(RUN_TIME) requirements-dev.lock
	$(PIP) install -r requirements.lock -r requirements-dev.lock
	touch $@

demo: $(RUN_TIME)
	$(BIN)/sonarpost demo $(ARGS)

# Two at a time, a file's tests together and those of real processes one after the other (tests/conftest.py).
test: setup
	$(BIN)/python -m pytest --numprocesses 2 --dist loadfile --no-loadscope-reorder $(ARGS)

# Tests that take minutes each: long outages, processes killed at random for five minutes.
test-long: setup
	$(BIN)/python -m pytest -m long -o faulthandler_timeout=1800 $(ARGS)

check: setup docs
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python tests/check_wheel.py

# The images that docker-compose.yml names; where no registry is reached they are made from Debian and PyPI alone.
images:
	packaging/images.sh

# The whole chain in containers, built, started, disturbed and taken away again. Needs a container engine.
test-compose: setup
	PYTHON=$(BIN)/python packaging/test-compose.sh $(ARGS)

# The pictures of the console's page in docs/explanation/console; needs Chromium.
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

# Resolve the dependencies of pyproject.toml again and write down the exact versions: those of the run time with the
# build tools of an editable installation, then those that tests, checks and documentation need besides.
lock:
	rm -rf build/lock && $(PYTHON) -m venv build/lock
	build/lock/bin/python -m pip install --quiet --disable-pip-version-check . build editables hatchling
	build/lock/bin/python -m pip freeze --exclude sonarpost > requirements.lock
	build/lock/bin/python -m pip install --quiet --disable-pip-version-check -c requirements.lock '.[dev,docs]'
	build/lock/bin/python -m pip freeze --exclude sonarpost | grep -vxFf requirements.lock > requirements-dev.lock

clean:
	rm -rf $(VENV) build dist demo-out .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
