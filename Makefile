# sonarpost: `make demo` runs the whole chain, `make test` the whole test suite. Both set up what they need.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.ready

.PHONY: setup demo test test-long check docs docs-serve fmt lock clean images test-compose screenshots

setup: $(STAMP)

# Exactly the locked versions, then the project itself, editable, without asking any index again.
$(STAMP): requirements.lock pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	touch $@

demo: setup
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
	$(BIN)/mkdocs --quiet build --strict

docs-serve: export NO_MKDOCS_2_WARNING = 1
docs-serve: setup
	$(BIN)/mkdocs serve $(ARGS)

fmt: setup
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

# Resolve the dependencies of pyproject.toml anew and write the exact versions down.
lock:
	rm -rf build/lock && $(PYTHON) -m venv build/lock
	build/lock/bin/python -m pip install --quiet --disable-pip-version-check '.[dev,docs]'
	build/lock/bin/python -m pip freeze --exclude sonarpost > requirements.lock

clean:
	rm -rf $(VENV) build dist demo-out .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
