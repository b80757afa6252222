# sonarpost: `make demo` runs the whole chain, `make test` the whole test suite. Both install what they need.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
RUN_TIME := $(VENV)/.run-time
STAMP := $(VENV)/.ready
PIP := $(BIN)/python -m pip --disable-pip-version-check --quiet

# Set on some machines; without cached byte code every test process would compile the whole package.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: setup demo test test-long check docs docs-serve fmt lock sbom audit clean images test-compose screenshots

setup: $(STAMP)

# The locked run-time dependencies, sonarpost itself, editable, and the machine code of its codecs. Enough for `make demo`.
$(RUN_TIME): requirements.lock requirements-build.lock pyproject.toml
	@echo "1 of 3: creating $(VENV) and installing the locked packages: 150 MB to download, about 30 s and the download"
	@$(PYTHON) -m venv $(VENV)
	@$(PIP) install --require-hashes -r requirements.lock
	@echo "2 of 3: installing sonarpost: about 10 s"
	@$(PIP) install --require-hashes -r requirements-build.lock
	@$(PIP) install --no-deps --no-build-isolation -e .
	@echo "3 of 3: compiling the codecs: about 10 s"
	@$(BIN)/sonarpost prepare
	touch $@

# The tools for tests, checks and documentation.
$(STAMP): $(RUN_TIME) requirements-dev.lock
	@echo "installing the tools for tests, checks and documentation: 300 MB to download, about 60 s and the download"
	@$(PIP) install --require-hashes -r requirements-dev.lock
	touch $@

demo: $(RUN_TIME)
	$(BIN)/sonarpost demo $(ARGS)

# Three workers: many tests wait for processes. Order and assignment to workers: tests/conftest.py.
test: setup
	$(BIN)/python -m pytest --numprocesses 3 --dist loadfile --no-loadscope-reorder $(ARGS)

# Tests of several minutes each: long outages, random faults in all processes for SONARPOST_CHAOS_S (1800) seconds,
# SONARPOST_SOAK_CONTACTS (1200) contacts through all services.
test-long: setup
	$(BIN)/python -m pytest -m long -o faulthandler_timeout=7200 \
		--numprocesses 2 --dist loadfile --no-loadscope-reorder $(ARGS)

check: setup docs
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python tests/check_wheel.py

# The images of docker-compose.yml; without an image registry they are built from Debian and PyPI. If debootstrap is needed
# and not installed, `make images INSTALL=yes` installs it on this host.
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

# Resolve the dependencies of pyproject.toml and write the newest versions with the hashes of all their files:
# requirements.lock for the run time, requirements-build.lock to build and install sonarpost, requirements-dev.lock for
# everything including tests, checks and documentation.
COMPILE = build/lock/bin/uv pip compile --quiet --upgrade --generate-hashes --python-version 3.11.5 \
	--custom-compile-command 'make lock'
lock:
	rm -rf build/lock && $(PYTHON) -m venv build/lock
	build/lock/bin/python -m pip install --quiet --disable-pip-version-check uv
	$(COMPILE) pyproject.toml --extra console --extra postgresql --output-file requirements.lock
	$(COMPILE) --group build --constraint requirements.lock --output-file requirements-build.lock
	$(COMPILE) pyproject.toml --group build --extra dev --extra docs \
		--constraint requirements.lock --constraint requirements-build.lock --output-file requirements-dev.lock

# The software bill of materials of the run time, in dist: from an environment that holds the locked packages only.
sbom: setup
	rm -rf build/sbom && $(PYTHON) -m venv --without-pip build/sbom
	$(PIP) --python build/sbom install --require-hashes -r requirements.lock
	$(BIN)/python packaging/sbom.py build/sbom requirements.lock dist/sonarpost.cdx.json

# Known vulnerabilities of the locked packages. It needs PyPI's JSON interface, and prints which packages it has no data for.
audit: setup
	$(BIN)/python packaging/audit.py requirements.lock requirements-build.lock

clean:
	rm -rf $(VENV) build dist demo-out .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
