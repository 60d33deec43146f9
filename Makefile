# make bench and make test need python3 (3.11 or later), gcc and make; each installs what it needs into .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt
# One BLAS thread: timings that can be compared, and the same bits on every run.
PINNED := OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 MKL_NUM_THREADS=1
# Bytecode is kept: tests start hundreds of processes that import koopmpc.
PYTEST := $(PINNED) PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder --benchmark-disable
TYPED := KOOPMPC_TESTS=typed $(PYTEST)

.PHONY: bench test typed full mutants loops real soak speed docs check format clean embedded lowest newest

bench: $(VENV)/installed
	$(PINNED) $(BIN)/koopmpc bench

# What users run, with every QP checked against its KKT conditions.
test: $(VENV)/installed-dev
	$(PYTEST)

# The same tests with shapes checked by the type hook.
typed: $(VENV)/installed-dev
	$(TYPED)

# All counts that the issues name, and coverage, which doubles the time.
full: $(VENV)/installed-dev
	$(TYPED) --cov --cov-report=term -m "(slow or not slow) and not speed and not loops and not real"

# 200 small changes of the library, of which the tests must notice 92 %: each meets the tests that run it. SEED=N draws 200
# others, from all rooms and the C; SEED="4 5" both of these, after one run of the suite.
SEED ?= 0
mutants: $(VENV)/installed-dev
	$(PINNED) $(BIN)/python -m tests.mutation --seeds $(SEED) --least $(if $(filter 0,$(SEED)),0.92,0.9)

loops: $(VENV)/installed-dev
	KOOPMPC_TESTS=bare $(PINNED) $(BIN)/python -m pytest -n 2 --benchmark-disable -m loops tests/closed_loop

# Free-run errors on measured records and their twins; KOOPMPC_RECORDS names the folder of the records.
real: $(VENV)/installed-dev
	KOOPMPC_TESTS=bare $(PINNED) $(BIN)/python -m pytest -n 2 --benchmark-disable -m real tests/real

# Benchmarks, then each row of docs/speed.md as it is here.
speed: $(VENV)/installed-dev
	KOOPMPC_TESTS=bare $(PINNED) $(BIN)/python -m pytest tests/speed -m speed --benchmark-columns=median,iqr,rounds --benchmark-sort=name
	$(BIN)/python -m tests.speed.figures.turns --every

# Closed loops with faults, damaged files, designs, kills and interrupts, for MINUTES; memory must stay flat.
MINUTES ?= 10
soak: $(VENV)/installed-dev
	$(PINNED) $(BIN)/python -m tests.faults.soak --minutes $(MINUTES)

# Three controllers in C on an emulated Cortex-M4F; says so where the Debian packages for it are missing.
embedded: $(VENV)/installed-dev
	$(PINNED) $(BIN)/python -m tests.embedded.run

# In an environment of its own, the lowest versions that pyproject.toml allows; warnings of newer neighbours of old packages
# are no errors here.
LOWEST := tests/test_front_door.py tests/test_checks.py tests/test_values.py tests/test_cli.py tests/views tests/lifting \
	tests/control tests/models tests/codegen tests/models tests/loop tests/validate tests/guarantees
lowest: $(VENV)/lowest/bin/python
	$(PYTHON) -m tests.lowest > $(VENV)/lowest/constraints.txt
	$< -m pip install --quiet --disable-pip-version-check -c $(VENV)/lowest/constraints.txt -e ".[dask,gym,sklearn]" \
		pytest pytest-xdist pytest-benchmark hypothesis beartype
	$< -m pip check
	$(PINNED) $< -m pytest -n 2 --dist loadfile --benchmark-disable -W default $(LOWEST)

# In an environment of its own, the newest of everything, without our constraints.
newest: $(VENV)/newest/bin/python
	$< -m pip install --quiet --disable-pip-version-check --upgrade --upgrade-strategy eager -e ".[dev]"
	$< -m pip check
	$(PINNED) $< -m pytest -n 2 --dist loadfile --benchmark-disable

$(VENV)/lowest/bin/python $(VENV)/newest/bin/python:
	$(PYTHON) -m venv $(patsubst %/bin/python,%,$@)

# The site, into site/: strict, and without a network once the tools are installed.
docs: $(VENV)/installed-docs
	NO_MKDOCS_2_WARNING=1 $(PINNED) $(BIN)/mkdocs build --strict --quiet

check: $(VENV)/installed-dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/lint-imports --no-cache
	$(BIN)/basedpyright

format: $(VENV)/installed-dev
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

clean:
	rm -rf $(VENV) .pytest_cache .ruff_cache .hypothesis .benchmarks .coverage dist build site

$(VENV)/bin/python:
	$(PYTHON) -m venv $(VENV)

$(VENV)/installed: $(VENV)/bin/python pyproject.toml constraints.txt
	$(PIP) -e .
	touch $@

$(VENV)/installed-dev: $(VENV)/installed
	$(PIP) -e ".[dev]"
	touch $@

$(VENV)/installed-docs: $(VENV)/installed
	$(PIP) -e ".[docs]"
	touch $@
