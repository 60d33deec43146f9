# make bench and make test need python3 (3.11 or later), gcc and make; each installs what it needs into .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt
# One BLAS thread: timings that can be compared, and the same bits on every run.
PINNED := OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 MKL_NUM_THREADS=1

.PHONY: bench test full speed check format clean

bench: $(VENV)/installed
	$(PINNED) $(BIN)/koopmpc bench

test: $(VENV)/installed-dev
	$(PINNED) $(BIN)/python -m pytest -n 2 --dist loadfile --benchmark-disable --cov --cov-report=term

full: $(VENV)/installed-dev
	$(PINNED) $(BIN)/python -m pytest -n 2 --dist loadfile --benchmark-disable -m "(slow or not slow) and not speed" --cov --cov-report=term

speed: $(VENV)/installed-dev
	KOOPMPC_NO_TYPE_HOOK=1 $(PINNED) $(BIN)/python -m pytest tests/speed -m speed --benchmark-columns=median,iqr,rounds --benchmark-sort=name

check: $(VENV)/installed-dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/lint-imports --no-cache
	$(BIN)/basedpyright

format: $(VENV)/installed-dev
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

clean:
	rm -rf $(VENV) .pytest_cache .ruff_cache .hypothesis .benchmarks .coverage dist build

$(VENV)/bin/python:
	$(PYTHON) -m venv $(VENV)

$(VENV)/installed: $(VENV)/bin/python pyproject.toml constraints.txt
	$(PIP) -e .
	touch $@

$(VENV)/installed-dev: $(VENV)/installed
	$(PIP) -e ".[dev]"
	touch $@
