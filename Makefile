# Everything runs from .venv, which `make install` builds from this folder with Python's own venv.
PYTHON ?= python3
VENV := .venv
ARGS ?=

# A sourced ROS, or a Python of somebody's own, must not leak into the environment.
unexport PYTHONPATH PYTHONHOME LD_LIBRARY_PATH AMENT_PREFIX_PATH CMAKE_PREFIX_PATH
unexport RMW_IMPLEMENTATION _ROS_WHEELS_BOOTSTRAP_COMPLETE

# What is installed. The folders are listed too, because a removed file changes its folder.
FOLDERS := $(shell find $(wildcard fourbar_ros config launch scripts resource) \
  -type d ! -name __pycache__)
SOURCES := package.xml $(FOLDERS) \
  $(shell find $(FOLDERS) -maxdepth 1 -type f ! -name '*.pyc' ! -name '.*')
RECIPE := setup.py setup.cfg $(wildcard pyproject.toml)
PIP_INSTALL := $(VENV)/bin/python -m pip install --disable-pip-version-check --quiet
CLEAR_BUILD := rm -rf build *.egg-info
# Carries the time when the last complete install began; without it .venv is built anew.
INSTALLED := $(VENV)/.installed

.PHONY: help install demo bench test lint clean

help:
	@echo 'make install   build .venv and install the package into it'
	@echo 'make demo      run the simulated testbed, closed loop'
	@echo 'make bench     time the mechanics beside MuJoCo, numbers in bench.json'
	@echo 'make test      run all tests           (ARGS="-k closure" for some of them)'
	@echo 'make lint      check style and types'
	@echo 'make clean     remove .venv and everything else that was built'

install: $(INSTALLED)

demo: $(INSTALLED)
	@$(VENV)/bin/fourbar demo $(ARGS)

bench: $(INSTALLED)
	@$(VENV)/bin/fourbar bench --json bench.json $(ARGS)

# Those that start processes come one after the other, and wait for each other most of the time. The
# rest compute in the meantime, with what is left of the machine, one thread each, and are told of
# afterwards.
ALONE := node or package
LEISURELY := $(shell command -v chrt >/dev/null && echo chrt --idle 0 || echo nice -n 19)
test: $(INSTALLED)
ifeq ($(ARGS),)
	@OPENBLAS_NUM_THREADS=1 $(LEISURELY) $(VENV)/bin/pytest -m 'not ($(ALONE))' -n auto --dist loadfile \
	  > $(VENV)/rest.log 2>&1 & rest=$$!; trap 'kill $$rest' INT TERM; \
	$(VENV)/bin/pytest -m '$(ALONE)'; alone=$$?; \
	wait $$rest; others=$$?; cat $(VENV)/rest.log; \
	exit $$(( alone ? alone : others ))
else
	@$(VENV)/bin/pytest $(ARGS)
endif

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
