# Two commands: `make run` and `make test`. The rest is for who changes the code.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
HDT_HOME ?= hdt_home
LANDING ?= data_samples
RUN_READY := $(VENV)/.ready-run
READY := $(VENV)/.ready
INSTALL := $(BIN)/pip install --quiet --no-deps --require-hashes
COMPILE := $(BIN)/uv pip compile --quiet --custom-compile-command 'make lock' --universal --python-version 3.11 --generate-hashes \
	--no-emit-index-url --no-emit-find-links --no-strip-extras --no-emit-package hybrid-digital-twin
EXTRAS := --extra speed --extra ui --extra postgres --extra celery --extra docs --extra serve --extra s3 --extra notebook \
	--extra dashboard --extra fmi --extra genetic --extra metrics --extra dev
PACKAGES := hdt_core pipelines dagster_batched sql extensions benchmarks
unexport PYTHONDONTWRITEBYTECODE  # or every process of a test compiles the tree anew

.PHONY: run test test-long mutate real soak audit dagster check lint types imports sql docs setup lock clean ui words

run: $(RUN_READY)
	$(BIN)/hdt nightly --landing $(LANDING) --home $(HDT_HOME)
	$(BIN)/hdt report --home $(HDT_HOME) --out $(HDT_HOME)/report.html

test: $(READY)
	$(BIN)/python -m pytest -n 2 --dist worksteal

# tests of tests/long.toml, all or with CHANGED=1 those whose sources changed since they last passed (tests/passed.json)
test-long: $(READY)
	$(BIN)/python -m pytest -n 2 --dist worksteal --long $(if $(CHANGED),changed,all)

# which small edits of a room (margin, health, ...) its tests notice: survivors and score; MODULE=name for one module
mutate: $(READY)
	$(BIN)/python -m benchmarks.mutation $(ROOM) --sample $(or $(SAMPLE),60) --seed $(or $(SEED),1) --module "$(or $(MODULE),*)"

# real data sets, from the folder HDT_REFERENCE: docs/real.md says what belongs there; hours
real: $(READY)
	$(BIN)/python -m benchmarks.real --write

# a thousand kills at random moments of a night, and damages; HDT_SOAK_KILLS=n, HDT_SOAK_DAMAGES=n for more
soak: $(READY)
	HDT_SOAK_KILLS=$${HDT_SOAK_KILLS:-1000} HDT_SOAK_DAMAGES=$${HDT_SOAK_DAMAGES:-1000} $(BIN)/python -m pytest tests/faults -s

# what leans on Dagster's private API, with the oldest version that is supported
dagster: $(READY)
	.ci/dagster 1.12.22

# needs the index's advisories, so it is no part of `check`; writes sbom.json (CycloneDX) too
audit: $(READY)
	python3 -m venv .audit && .audit/bin/pip install --quiet pip-audit
	.ci/sbom < requirements.lock > sbom.json
	.audit/bin/pip-audit -r requirements.lock --disable-pip --require-hashes --progress-spinner off -f json | .ci/audited

# side by side with `make -j2 check`
check: lint types imports sql docs

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(READY)
	$(BIN)/mypy

imports: $(READY)
	$(BIN)/lint-imports

sql: $(READY)
	$(BIN)/sqlfluff lint sql

docs: $(READY)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet --site-dir .site

ui: $(READY)
	HDT_HOME=$(abspath $(HDT_HOME)) HDT_LANDING=$(abspath $(LANDING)) $(BIN)/hdt ui

setup: $(READY)

# what a night and its report need
$(RUN_READY): requirements-run.lock pyproject.toml extensions/pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(INSTALL) -r requirements-run.lock
	$(BIN)/pip install --quiet --no-deps --no-build-isolation -e . -e extensions
	$(BIN)/python -m compileall -q $(PACKAGES)  # a second of every process where Python is told to write no bytecode
	touch $@

# and the rest, of the same resolution
$(READY): $(RUN_READY) requirements.lock
	$(INSTALL) -r requirements.lock
	touch $@

# setuptools builds this project from the same pinned set, so it is named here and not in the dependencies; ecos has no wheel
# for Python 3.13 and is called by nothing here: a solver of scikit-survival, of which benchmarks use the scores
lock:
	$(COMPILE) --no-emit-package ecos $(EXTRAS) pyproject.toml extensions/pyproject.toml build-requirements.in -o requirements.lock
	$(COMPILE) --constraint requirements.lock --extra speed pyproject.toml build-requirements.in -o requirements-run.lock

# every message of code, templates and declarations, into the catalog of each language
words: $(READY)
	$(BIN)/python -m docs.translations

clean:
	rm -rf $(VENV) $(HDT_HOME) .pytest_cache .mypy_cache .ruff_cache
