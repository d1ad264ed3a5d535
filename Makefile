# make setup  .venv with everything in it          make lint   ruff, pyright and import rules
# make run    one episode with a live view         make bench  measurements, as JSON
# make results  the tables and figures of the paper, the model cards
# make docs   the API reference, in build/docs
# make test   the test suite
#
# PYTHON chooses the interpreter for .venv; ARGS are passed on, as in: make run ARGS="--difficulty 1"

PYTHON ?= python3
BIN := .venv/bin
STAMP := .venv/.installed
INPUTS := pyproject.toml setup.py mujoban_msgs_py/interface_build.py $(wildcard mujoban_msgs_py/msg/*.msg)
ARGS ?=
PACKAGES := mujoban_core mujoban_sokoban mujoban_msgs_py mujoban_sim mujoban_rl mujoban_estimator mujoban_planner \
  mujoban_controller bringup

.PHONY: setup run test lint bench results docs clean

setup: $(STAMP)

$(STAMP): $(INPUTS) bringup/check_machine.py
	@$(PYTHON) bringup/check_machine.py
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --editable '.[dev]'
	@touch $@

run: $(STAMP)
	$(BIN)/python bringup/run_stack.py $(ARGS)

test: $(STAMP)
	$(BIN)/python -m pytest $(ARGS)

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/pyright
	$(BIN)/lint-imports

results: $(STAMP)
	$(BIN)/python -m benchmarks.paper
	$(BIN)/python -m benchmarks.model_cards

docs: $(STAMP)
	MUJOCO_GL=egl PYTHONWARNINGS=ignore $(BIN)/pdoc --docformat google --no-show-source --output-directory build/docs $(PACKAGES)

bench: $(STAMP)
	$(BIN)/python -m benchmarks $(ARGS)

clean:
	rm -rf .venv build mujoban_msgs mujoban.egg-info
