# Everything runs from .venv, which `make install` builds from this folder with Python's own venv.
PYTHON ?= python3
VENV := .venv
ARGS ?=

# The environment of a sourced ROS or of another Python must not reach .venv.
unexport PYTHONPATH PYTHONHOME LD_LIBRARY_PATH AMENT_PREFIX_PATH CMAKE_PREFIX_PATH
unexport RMW_IMPLEMENTATION _ROS_WHEELS_BOOTSTRAP_COMPLETE

# Sources of the installation. Folders are listed too: a removed file changes its folder.
FOLDERS := $(shell find $(wildcard fourbar_ros config launch scripts resource) \
  -type d ! -name __pycache__)
SOURCES := package.xml $(FOLDERS) \
  $(shell find $(FOLDERS) -maxdepth 1 -type f ! -name '*.pyc' ! -name '.*')
RECIPE := setup.py setup.cfg $(wildcard pyproject.toml)
PIP_INSTALL := $(VENV)/bin/python -m pip install --disable-pip-version-check --quiet
CLEAR_BUILD := rm -rf build *.egg-info
# Its time is the start of the last complete installation; without it .venv is built anew.
INSTALLED := $(VENV)/.installed

.PHONY: help install demo bench test test-quick test-long lint clean

help:
	@echo 'make install   build .venv and install the package into it'
	@echo 'make demo      run the simulated testbed, closed loop'
	@echo 'make test      run all tests but the slow ones (ARGS="-k closure" for a selection)'
	@echo 'make test-quick  run the quick tests, which start no node'
	@echo 'make test-long   run the slow tests: campaigns, studies, long runs'
	@echo 'make bench     time the mechanics beside MuJoCo, numbers in bench.json'
	@echo 'make lint      check style and types'
	@echo 'make clean     remove .venv and everything else that was built'

install: $(INSTALLED)

demo: $(INSTALLED)
	@$(VENV)/bin/fourbar demo $(ARGS)

bench: $(INSTALLED)
	@$(VENV)/bin/fourbar bench --json bench.json $(ARGS)

# Tests that start processes run one after the other in one worker; the other worker computes
# meanwhile (test/conftest.py). One thread each, since there are as many workers as cores.
PYTEST := OPENBLAS_NUM_THREADS=1 $(VENV)/bin/pytest
WORKERS := -q -n auto --dist loadscope --no-loadscope-reorder

test: $(INSTALLED)
	@$(PYTEST) $(if $(ARGS),$(ARGS),$(WORKERS) -m 'not slow')

test-quick: $(INSTALLED)
	@$(PYTEST) $(WORKERS) -m 'not (medium or slow or node or package)' $(ARGS)

test-long: $(INSTALLED)
	@$(PYTEST) $(WORKERS) -m slow $(ARGS)

lint: $(INSTALLED)
	$(VENV)/bin/ruff check .
	$(VENV)/bin/mypy

clean:
	rm -rf $(VENV) build install log *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(INSTALLED): $(RECIPE) $(SOURCES)
	@$(if $(wildcard $@),,$(new_environment))
	@touch $(VENV)/.started && rm -f $@ && $(CLEAR_BUILD)
	@$(if $(filter $(RECIPE),$?),$(install_all),$(install_package))
	@$(CLEAR_BUILD) && mv $(VENV)/.started $@

define new_environment
$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || \
  { echo 'Python 3.10 or later is needed: make install PYTHON=python3.12' >&2; exit 1; }; \
$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || \
  { echo 'Python has no venv here: apt install python3-venv' >&2; exit 1; }; \
echo 'Building $(VENV)'; \
rm -rf $(VENV) && $(PYTHON) -m venv $(VENV) && touch $(VENV)/COLCON_IGNORE
endef

define install_all
echo 'Installing the package and all it needs: this takes about a minute'; \
$(PIP_INSTALL) '.[all]'
endef

define install_package
echo 'Installing the package again'; \
$(PIP_INSTALL) --no-deps --force-reinstall .
endef
