# sonarpost: `make demo` runs the whole chain, `make test` the quick tests. Both install what they need.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
RUN_TIME := $(VENV)/.run-time
TEST := $(VENV)/.test
DEV := $(VENV)/.dev
PIP := $(BIN)/python -m pip --disable-pip-version-check --quiet
PYTEST := $(BIN)/python -m pytest

# Set on some machines; without cached byte code every process of the tests would compile the whole package.
unexport PYTHONDONTWRITEBYTECODE
# Several tests run at once; a second thread of each would only wait for the others.
export OPENBLAS_NUM_THREADS ?= 1

.PHONY: setup demo test test-busy test-extensions test-system test-processes check docs docs-serve fmt lock sbom audit clean images test-compose screenshots

setup: $(TEST)

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

# The packages of the quick tests.
$(TEST): $(RUN_TIME) requirements-test.lock
	@echo "installing the packages of the tests: 20 MB to download"
	@$(PIP) install --require-hashes -r requirements-test.lock
	touch $@

# The packages of all tests, checks and the documentation.
$(DEV): $(TEST) requirements-dev.lock
	@echo "installing the tools for system tests, checks and documentation: 150 MB to download, about 40 s and the download"
	@$(PIP) install --require-hashes -r requirements-dev.lock
	touch $@

demo: $(RUN_TIME)
	$(BIN)/sonarpost demo $(ARGS)

# The quick tests, at most five minutes on two cores. Tiers and order: tests/conftest.py.
test: setup
	$(PYTEST) --numprocesses 3 --dist loadfile --no-loadscope-reorder $(ARGS)

# The quick tests beside four busy processes: no test may depend on the speed of the machine.
test-busy: setup
	@for _ in 1 2 3 4; do while :; do :; done & loops="$$loops $$!"; done; trap 'kill $$loops' EXIT; \
	$(MAKE) --no-print-directory test

# Chains with faults, browsers, TLS, research commands, examples, PostgreSQL, containers, and all property tests with more
# examples. Longer runs of the tests of faults: docs/research/faults.md.
test-system: $(DEV)
	$(MAKE) --no-print-directory -j2 test-processes test-compose

test-processes: $(DEV)
	$(PYTEST) -m "(system or hypothesis) and not containers" --hypothesis-profile thorough \
		--numprocesses 4 --dist loadfile --no-loadscope-reorder $(ARGS)

DENO = DENO_NO_UPDATE_CHECK=1 $(BIN)/deno --quiet
SCRIPTS := --config packaging/deno.json services/console/static/js
check: $(DEV) docs
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(DENO) check $(SCRIPTS)
	$(DENO) lint $(SCRIPTS) services/console/static/service_worker.js

# The images of docker-compose.yml; without an image registry they are built from Debian and PyPI. If debootstrap is needed
# and not installed, `make images INSTALL=yes` installs it on this host.
images:
	packaging/images.sh

# The whole chain in containers: build, start, inject faults, remove. Needs a container engine.
test-compose: $(DEV)
	PYTHON=$(BIN)/python packaging/test-compose.sh $(ARGS)

# The quick tests without each extension, and without all of them; ARGS=NAME for one. About four minutes each.
test-extensions: setup
	$(BIN)/python tests/check_extensions.py $(ARGS)

# The screenshots in docs/explanation/console; needs Chromium.
screenshots: $(DEV)
	$(BIN)/python packaging/screenshots.py

# The documentation site, in build/site; a broken link or an undocumented name fails the build.
docs: export NO_MKDOCS_2_WARNING = 1
docs: $(DEV)
	$(BIN)/mkdocs build --strict

docs-serve: export NO_MKDOCS_2_WARNING = 1
docs-serve: $(DEV)
	$(BIN)/mkdocs serve $(ARGS)

fmt: $(DEV)
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

# Resolve the dependencies of pyproject.toml and write the newest versions with the hashes of all their files:
# requirements.lock for the run time, requirements-build.lock to build and install sonarpost, requirements-test.lock for the
# quick tests, requirements-dev.lock for all tests, checks and documentation, requirements-release.lock for sbom and audit.
COMPILE = build/lock/bin/uv pip compile --quiet --upgrade --generate-hashes --python-version 3.11.5 \
	--custom-compile-command 'make lock'
lock:
	rm -rf build/lock && $(PYTHON) -m venv build/lock
	build/lock/bin/python -m pip install --quiet --disable-pip-version-check uv
	$(COMPILE) pyproject.toml --extra console --extra postgresql --output-file requirements.lock
	$(COMPILE) --group build --constraint requirements.lock --output-file requirements-build.lock
	$(COMPILE) pyproject.toml --extra dev --constraint requirements.lock --constraint requirements-build.lock \
		--output-file requirements-dev.lock
	$(COMPILE) pyproject.toml --extra test --constraint requirements-dev.lock --output-file requirements-test.lock
	$(COMPILE) --group release --output-file requirements-release.lock

# The tools of sbom and audit, in an environment of their own.
RELEASE := build/release
$(RELEASE)/.ready: requirements-release.lock
	rm -rf $(RELEASE) && $(PYTHON) -m venv $(RELEASE)
	$(RELEASE)/bin/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements-release.lock
	touch $@

# The software bill of materials of the run time, in dist: from an environment that holds the locked packages only.
sbom: $(RELEASE)/.ready
	rm -rf build/sbom && $(PYTHON) -m venv --without-pip build/sbom
	$(RELEASE)/bin/python -m pip --python build/sbom install --quiet --require-hashes -r requirements.lock
	$(RELEASE)/bin/python packaging/sbom.py build/sbom requirements.lock dist/sonarpost.cdx.json

# Known vulnerabilities of the locked packages. It needs PyPI's JSON interface, and prints which packages it has no data for.
audit: $(RELEASE)/.ready
	$(RELEASE)/bin/python packaging/audit.py requirements.lock requirements-build.lock

clean:
	rm -rf $(VENV) build dist demo-out .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
