# Every target does its own set-up: python3 with venv, and make, are enough.

PYTHON ?= python3
# Where the oldest declared versions are tried; the first of these that runs.
OLDEST_PYTHON ?= $(shell for p in python3.12 python3.11 python3.10 $(PYTHON); do \
	$$p -c '' 2>/dev/null && echo $$p && break; done)

# Two cores: processes run side by side, so each keeps to one thread.
export OPENBLAS_NUM_THREADS = 1
export OMP_NUM_THREADS = 1

# ROS keeps to this machine and, where the caller chose none, to a domain of its own.
export ROS_AUTOMATIC_DISCOVERY_RANGE = LOCALHOST
ifndef ROS_DOMAIN_ID
export ROS_DOMAIN_ID := $(shell echo $$(($$$$ % 90 + 10)))
endif

BIN = .venv/bin
PACKAGED = setup.py setup.cfg pyproject.toml package.xml $(wildcard resource/* config/* landmark_nav/launch/*)

.PHONY: install demo test test-unit test-ros lint bench test-oldest clean

install: .venv/installed

# Editable, so that code is run as it is written; what is copied (config, launch files, executables)
# is copied anew when it changes.
.venv/installed: $(PACKAGED)
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --editable '.[ros,dev]'
	touch $@

demo: install
	$(BIN)/landmark-nav demo --out demo

test: lint test-unit test-ros

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy landmark_nav

test-unit: install
	$(BIN)/python -m pytest -q -n 2 test/unit

# One after the other: these start nodes as processes of their own.
test-ros: install test-unit
	$(BIN)/python -m pytest -q test/nodes test/system

bench: install
	$(BIN)/landmark-nav bench

test-oldest: .venv-oldest/installed
	.venv-oldest/bin/python -m pytest -q -n 2 test/unit

.venv-oldest/installed: setup.py pyproject.toml test/oldest.txt
	$(OLDEST_PYTHON) -m venv .venv-oldest
	.venv-oldest/bin/python -m pip install --quiet --upgrade pip
	.venv-oldest/bin/python -m pip install --quiet -r test/oldest.txt --editable .
	touch $@

clean:
	rm -rf .venv .venv-oldest build dist *.egg-info demo .pytest_cache .mypy_cache .ruff_cache .hypothesis
