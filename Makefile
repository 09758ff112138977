# make demo: the whole chain without hardware.   make test: every check.   Both do all set-up themselves.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
WHEEL_VENV := .venv-wheel
PACKAGES := level1 bridge firmware_py dbc level2 ucs
.DEFAULT_GOAL := help
.NOTPARALLEL:
.PHONY: help demo test check test-wheel golden coverage soak season clean packages packages-vcan

help:
	@echo "make demo        simulated tractor and implements, faults, repairs, level 2: about a minute"
	@echo "make test        ruff, mypy, import rules, all tests (those on virtual CAN buses too)"
	@echo "make check       ruff, mypy and import rules only"
	@echo "make test-wheel  the unit tests against the built and installed wheel"
	@echo "make golden      declare the events that the examples give now (see examples/README.md)"
	@echo "make coverage    write docs/coverage.md: which tests prove which line of the specification"
	@echo "make soak        kills, power cuts, forged commands, NATS and pulled plugs at length: about 25 minutes; needs Go"
	@echo "make season      1,000 h of virtual time with random faults: hours; goes on where it was stopped"
	@echo "make clean       remove what these made"

demo: $(VENV)/ready
	$(BIN)/ucs demo

# In two goes, as only one program at a time may use the virtual CAN buses; `pytest` alone does the same in one.
test: packages-vcan check
	$(BIN)/python -m pytest -n auto --dist loadfile -m "not vcan"
	$(BIN)/python -m pytest -m vcan

check: $(VENV)/ready
	$(BIN)/ruff check
	$(BIN)/mypy
	$(BIN)/lint-imports --no-logo

# The packages as a user gets them, with their tests laid beside them; nothing is imported from this folder.
test-wheel: $(VENV)/ready
	rm -rf dist $(WHEEL_VENV)
	$(BIN)/python -m pip wheel --quiet --no-deps --wheel-dir dist .
	$(PYTHON) -m venv $(WHEEL_VENV)
	$(WHEEL_VENV)/bin/python -m pip install --quiet "$$(ls dist/*.whl)[unit]"
	site=$$($(WHEEL_VENV)/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))') && \
	for package in $(PACKAGES); do \
	    if [ -d $$package/tests ]; then cp -r $$package/tests $$site/$$package/; fi; \
	done && \
	cp pyproject.toml README.md $$site/ && cd $$site && \
	$(CURDIR)/$(WHEEL_VENV)/bin/python -m pytest -q -n auto --dist loadfile -m "not vcan" -p no:cacheprovider \
	    $$(for package in $(PACKAGES); do if [ -d $$package/tests ]; then echo $$package/tests; fi; done)

# Writes its counts into docs/reliability.md.
soak: $(VENV)/ready packages-vcan
	$(BIN)/python -m benchmarks.soak --write
	$(BIN)/python -m benchmarks.plugs --write

# Writes its counts into docs/reliability.md, too.
season: $(VENV)/ready
	$(BIN)/python -m benchmarks.season --write

golden: $(VENV)/ready
	$(BIN)/python -m examples.golden

coverage: $(VENV)/ready
	$(BIN)/python -m hil_tests.coverage

clean:
	rm -rf $(VENV) $(WHEEL_VENV) dist build .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache

packages:
	@PYTHON="$(PYTHON)" .ci/system-packages

packages-vcan:
	@PYTHON="$(PYTHON)" .ci/system-packages vcan

# Made anew only when pyproject.toml changes: the packages themselves are used in place.
$(VENV)/ready: pyproject.toml | packages
	@echo "Setting up $(VENV), once: it takes a minute or two."
	@$(PYTHON) -m venv $(VENV)
	@$(BIN)/python -m pip install --quiet --editable '.[test]'
	@touch $@
