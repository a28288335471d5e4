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
PACKAGED = setup.py setup.cfg pyproject.toml package.xml \
	$(shell find landmark_nav config resource -type f -not -name '*.pyc' -not -name '.*')

.PHONY: install demo test test-offline test-nodes lint bench ablation rooms variety landmarks alternatives cameras unmeasured \
	latency papers bad-sweeps degraded faults calibration fuzz docs docs-images test-oldest test-colcon clean

install: .venv/installed

# Not editable: setuptools then leaves out lib/landmark_nav and share, and tests should meet what a
# user gets. `build` would bring back files that are gone from the tree.
.venv/installed: $(PACKAGED)
	test -x $(BIN)/pip || $(PYTHON) -m venv .venv
	rm -rf build
	$(BIN)/python -m pip install --quiet --disable-pip-version-check '.[ros,dev,batch]'
	touch $@

demo: install
	$(BIN)/landmark-nav demo --out demo --overwrite

# Tests of nodes by themselves, as some run in real time.
test: install
	$(MAKE) --no-print-directory -j 2 lint test-offline
	$(MAKE) --no-print-directory test-nodes

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy landmark_nav

# The longest files first, so that both processes have work until the end.
test-offline: install
	$(BIN)/pytest -q -n 2 --dist loadfile --no-loadscope-reorder test/system test/fuzz test/unit

# These start nodes as processes of their own, each test in a ROS domain of its own.
test-nodes: install
	$(BIN)/pytest -q -n 2 --dist loadfile --no-loadscope-reorder test/nodes

bench: install
	$(BIN)/landmark-nav bench

# What each mechanism is worth: some hours; ROWS="--only 'way back' median" for a few of them.
ablation: install
	$(BIN)/python test/benchmarks ablation ablation $(ROWS)

# Rooms that nothing was tuned on, one line a room.
SEEDS ?= 901 902 903 904 905
rooms: install
	$(BIN)/python test/benchmarks rooms --seeds $(SEEDS)

# Other cameras and other rooms than those of the simulator's own making.
variety: install
	for camera in test/setups/camera_*.yaml; do $(BIN)/python test/benchmarks rooms --seeds 71 --camera $$camera || failed=1; done; \
	for room in test/setups/room_*.yaml; do $(BIN)/python test/benchmarks rooms --seeds 72 --room $$room || failed=1; done; \
	test -z "$$failed"

# Landmarks of the same rooms against the truth: where they are, and from where they are found.
landmarks: install
	$(BIN)/python test/benchmarks landmarks --area --seeds $(SEEDS)

# What alternatives, latency, degraded and faults take: bags/, or all of these; START is "X Y THETA".
ifndef DRIVE
DRIVE = bags/drive
LEARN = bags/learn
ROBOT = bags/robot.yaml
ROOM = bags/room.yaml
MAP = .bags-map
# Seconds before the faults, which the drive must outlast.
AT = --at 3
# At 15 images a second it would be over before the nodes are warm.
HZ = --hz 5
START = $(shell $(PYTHON) -c "import json; print(*json.load(open('bags/start.json'))['pose'])")
endif

.bags-map: .venv/installed
	$(BIN)/landmark-nav learn bags/learn --room bags/room.yaml --robot bags/robot.yaml --out $@ --overwrite
	touch $@

# This, and what else one could do.
alternatives: install $(MAP)
	$(BIN)/python test/benchmarks alternatives $(DRIVE) --learn $(LEARN) --map $(MAP) --robot $(ROBOT) --start $(START)

# The active camera against a fixed one and random triplets, in rooms that nothing was tuned on.
cameras: install
	$(BIN)/python test/benchmarks cameras --seeds $(SEEDS)

# From image to corrected pose on the live graph.
latency: install $(MAP)
	$(BIN)/python test/benchmarks latency $(DRIVE) --map $(MAP) --room $(ROOM) --robot $(ROBOT) --start $(START) $(HZ)

# Places that papers tell, errors against covariances.
papers: install
	$(BIN)/python test/benchmarks papers

# Sweeps that went wrong, through `learn`: a map that is right, or a clear refusal.
bad-sweeps: install
	$(BIN)/python test/benchmarks bad_sweeps

# Learning without a plan: simulated rooms, and the study; scale from odometry.
UNMEASURED ?= 801 802 803
unmeasured: install
	$(BIN)/python test/benchmarks unmeasured --study --seeds $(UNMEASURED)

# Errors of robot.yaml at driving and at learning, on the study.
calibration: install
	$(BIN)/python test/benchmarks calibration

# A drive with errors in its streams and images.
degraded: install $(MAP)
	$(BIN)/python test/benchmarks degraded $(DRIVE) --map $(MAP) --robot $(ROBOT) --room $(ROOM) --start $(START)

# A drive with faults of odometry, joints, camera and clock.
faults: install $(MAP)
	$(BIN)/python test/benchmarks faults $(DRIVE) --map $(MAP) --robot $(ROBOT) --start $(START) $(AT)

# Hostile files, bags and messages at every door: N inputs each, others than in CI and every time.
N ?= 1000
fuzz: install
	FUZZ_N=$(N) $(BIN)/pytest -q -n 2 test/fuzz

# The site, docs/_build/html: fails on warnings, dead links and what has no description.
docs: .venv/docs-installed
	rm -rf docs/_build docs/reference
	$(BIN)/sphinx-build -q -W --keep-going docs docs/_build/html
	@echo docs/_build/html/index.html

.venv/docs-installed: .venv/installed
	rm -rf build
	$(BIN)/python -m pip install --quiet --disable-pip-version-check '.[docs]'
	touch $@

# Its figures anew, by the commands of the product; 8 minutes.
docs-images: install
	$(BIN)/python docs/make_images.py

test-oldest: .venv-oldest/installed
	.venv-oldest/bin/pytest -q -n 2 test/unit

.venv-oldest/installed: $(PACKAGED) test/oldest.txt
	test -x .venv-oldest/bin/pip || $(OLDEST_PYTHON) -m venv .venv-oldest
	rm -rf build
	.venv-oldest/bin/python -m pip install --quiet --disable-pip-version-check -r test/oldest.txt .
	touch $@

# A workspace as `colcon build` leaves it; without landmark_nav from pip, which would hide what is missing.
test-colcon: .venv-colcon/installed
	.venv-colcon/bin/python test/colcon_check.py

.venv-colcon/installed: setup.py
	test -x .venv-colcon/bin/pip || $(PYTHON) -m venv .venv-colcon
	rm -rf build
	.venv-colcon/bin/python -m pip install --quiet --disable-pip-version-check '.[ros]' colcon-ros
	.venv-colcon/bin/python -m pip uninstall --quiet --yes landmark_nav
	touch $@

clean:
	rm -rf .bags-map .venv .venv-oldest .venv-colcon build docs/_build docs/reference dist *.egg-info demo .pytest_cache .mypy_cache .ruff_cache .hypothesis
