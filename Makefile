# make demo   play the example bag through the live graph
# make test   run the tests, but for those that take long
# make test-slow  run those that take long: browsers, tutorials, attacks, campaigns
# make test-all  run all tests; whole graphs that take long too, for which the machine must do nothing else
# make kernels  compile what nodes would compile when they first start
# make coverage  measure which lines of the core packages their tests run
# make lint   check style and types
# make colcon build both packages by colcon, in the workspace output/ws
# make docs  build the documentation into output/docs
# make peers  add the solvers of `python -m benchmarks solver --peers`
# make clean  remove all that make made
#
# Each sets up .venv the first time, over ROS 2 Jazzy as wheels from PyPI: `make demo` with what the package needs, the
# others with what tests and documentation need too. Needs Python 3.10 to 3.13 with venv and headers, a C and C++
# compiler, and make; nothing of ROS.

PYTHON ?= python3
VENV := .venv
EXTRAS := ros dev docs colcon cluster
INSTALLED := $(VENV)/.installed
READY := $(VENV)/.ready
RUN := $(VENV)/bin
DEMO := output/demo
# Those with whole graphs among their tests: to collect all tests again would take longer than to start a graph.
GRAPHS = $(shell grep --recursive --files-with-matches --word-regexp --include='test_*.py' whole_graph test)
# Slow ones that start graphs or browsers: one after the other.
ALONE := test/console/test_page.py test/test_site.py test/test_tutorials.py
MESSAGES := $(wildcard msg_defs/*.* msg_defs/*/*)

# What is imported is compiled then: the half of all modules. (pip takes this "no" for a yes.)
INSTALL = PIP_CONSTRAINT=constraints.txt PIP_NO_COMPILE=no $(RUN)/python -m pip install -qq --disable-pip-version-check

# Every node is a process that imports most of the packages: without their bytecode that takes it thrice as long.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test test-slow test-all kernels coverage lint docs colcon peers clean help
.PHONY: .packages .messages .kernels

demo: $(INSTALLED)
	@rm -rf $(DEMO)
	$(RUN)/magnetosuture replay examples/post_wrap --output $(DEMO)

TESTS := $(RUN)/python -m pytest
BESIDE := --numprocesses=2 --dist=worksteal

test: $(READY)
	$(TESTS) $(BESIDE) -m "not whole_graph and not slow"
	$(TESTS) -m "whole_graph and not slow" $(GRAPHS)

test-slow: $(READY)
	$(TESTS) $(BESIDE) -m "slow and not whole_graph" test $(addprefix --ignore=,$(ALONE))
	$(TESTS) -m "slow and not whole_graph" $(ALONE)

test-all: test test-slow
	$(TESTS) -m "slow and whole_graph" $(GRAPHS)

kernels: $(INSTALLED)
	$(RUN)/magnetosuture compile

# Of the packages' own tests; those of the page in a browser run the server in the same process.
coverage: $(READY)
	@mkdir -p output
	$(RUN)/python -m coverage run -m pytest -q $(addprefix test/,coils console estimator geometry planning thread vision)
	$(RUN)/python -m coverage report --skip-covered --show-missing

lint: $(READY)
	$(RUN)/ruff check .
	$(RUN)/ruff format --check .
	$(RUN)/mypy

# Warnings are errors; nothing is fetched.
docs: $(READY)
	$(RUN)/python -m sphinx --fail-on-warning --keep-going --quiet docs output/docs

# Both packages by colcon, over the wheels in .venv, in a workspace as docs/how_to/installation.md makes one.
colcon: $(READY)
	@mkdir -p output/ws/src
	@ln -sfn ../../.. output/ws/src/magnetosuture_thread
	@ln -sfn magnetosuture_thread/msg_defs output/ws/src/magnetosuture_msgs
	cd output/ws && PATH="$(CURDIR)/$(RUN):$$PATH" colcon build

# From the extra `peers`, without building the package again.
peers: $(READY)
	$(INSTALL) clarabel piqp

help:
	@sed -n 's/^# \(make .*\)/\1/p' Makefile

clean:
	rm -rf $(VENV) build output

# What the tests and the documentation need is added to what the package needs.
$(READY): $(INSTALLED)
	@echo "Adding to $(VENV) what tests and documentation need (1 minute)"
	$(RUN)/python .ci/requirements.py $(EXTRAS) >$(VENV)/requirements.txt
	$(INSTALL) --requirement $(VENV)/requirements.txt
	@touch $@

# The messages, which pip builds in an environment of its own, and the packages with the functions that they compile, at
# the same time: either keeps one processor busy.
$(INSTALLED): pyproject.toml constraints.txt $(MESSAGES)
	@echo "Setting up $(VENV): ROS 2 Jazzy and the other packages, the messages and compiled functions (2 minutes)"
	@$(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(0 if (3, 10) <= v < (3, 14) else f"Python {v[0]}.{v[1]} found, 3.10 to 3.13 needed; name one by: make PYTHON=python3.12")'
	@command -v c++ >/dev/null || { echo "no C++ compiler found; on Debian or Ubuntu: apt install build-essential python3-dev" >&2; exit 1; }
	@rm -rf $(VENV)
	$(PYTHON) -m venv $(VENV)
	@$(MAKE) --no-print-directory --jobs=2 .kernels .messages
	@touch $@

.packages:
	$(RUN)/python .ci/requirements.py ros >$(VENV)/requirements.txt
	$(INSTALL) --requirement $(VENV)/requirements.txt

.kernels: .packages
	$(RUN)/python -m magnetosuture_thread.cli compile

.messages:
	$(INSTALL) --no-deps --editable .
