# Everything runs from .venv, which the set-up fills; no target needs anything sourced.
PY := .venv/bin/python

# A sourced ROS installation must not mix with the one in .venv.
unexport AMENT_PREFIX_PATH CMAKE_PREFIX_PATH COLCON_PREFIX_PATH LD_LIBRARY_PATH PYTHONHOME PYTHONPATH
unexport RMW_IMPLEMENTATION _ROS_WHEELS_BOOTSTRAP_COMPLETE

# Every process that the tests start would compile the project anew.
unexport PYTHONDONTWRITEBYTECODE

# The graph stays on this machine unless the caller says otherwise.
ROS_AUTOMATIC_DISCOVERY_RANGE ?= LOCALHOST
export ROS_AUTOMATIC_DISCOVERY_RANGE

.PHONY: help setup demo test soak lint types bench scale peers experiments bags lock clean distclean

help: ## show this list
	@awk -F ':.*## ' '/^[a-z]+:.*## / {printf "  make %-11s %s\n", $$1, $$2}' $(MAKEFILE_LIST)
	@echo "  ARGS='...' is passed on: make test ARGS='tests/core -k pose'"

setup: ## fill .venv: pinned packages, ROS 2, the interfaces (PYTHON=python3.12 chooses the Python)
	@PYTHON="$(PYTHON)" ros_ws/wheels/bootstrap.sh

demo: setup ## print, scan, inspect and redesign a virtual part
	@.venv/bin/cell_demo $(ARGS)

test: export ROS_AUTOMATIC_DISCOVERY_RANGE = LOCALHOST
test: setup ## run the tests
	@$(PY) -m pytest --numprocesses 2 --dist loadfile $(ARGS)

soak: export SOAK_SCANS ?= 500
soak: setup ## 500 scans through a cell that is killed again and again (SOAK_SCANS=...)
	@$(PY) -m pytest -o faulthandler_timeout=0 tests/system/test_soak.py $(ARGS)

lint: setup ## ruff, rules and format
	@.venv/bin/ruff check --no-cache .
	@.venv/bin/ruff format --check .

types: setup ## mypy, strict on mdf_core
	@.venv/bin/mypy

bench: setup ## run the benchmarks (ARGS='--out docs/benchmarks' keeps the results)
	@$(PY) -m bench $(ARGS)

scale: setup ## run MDF, CPD and the surface stage at the paper's scale
	@$(PY) -m bench.paper_scale $(ARGS)

peers: setup ## put the methods that bench compares with into .venv (large, optional)
	@$(PY) -m pip install --constraint requirements/lock.txt --requirement requirements/bench.txt

experiments: setup ## run the paper's experiments again and write docs/experiments
	@$(PY) -m bench.paper $(ARGS)

bags: setup ## record the bags again
	@$(PY) bags/record.py $(ARGS)

lock: setup ## resolve requirements/*.in anew into requirements/lock.txt
	@$(PY) -m pip install --quiet uv
	@.venv/bin/uv pip compile --quiet --upgrade --universal --python-version 3.10 \
	  --no-emit-index-url --no-emit-find-links --no-annotate --custom-compile-command "make lock" \
	  --output-file requirements/lock.txt requirements/run.in requirements/ros.in requirements/build.in requirements/dev.in

clean: ## remove what tests and builds leave; keep .venv
	rm -rf build dist ./*.egg-info .hypothesis .mypy_cache .pytest_cache .ruff_cache
	find . -path ./.venv -prune -o -type d -name __pycache__ -exec rm -rf {} +

distclean: clean ## remove .venv too
	rm -rf .venv
