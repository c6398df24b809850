# Every target works as the first command on a machine with Python 3.10+ and make; `make PYTHON=python3.12 test` picks another.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
SOURCES := sb3_progpolicy envs examples benchmarks tests docs
# Networks this small run faster on one thread each, and the tests on one process per core.
ONE_THREAD := OMP_NUM_THREADS=1 MKL_NUM_THREADS=1

.PHONY: help install demo test test-long smoke lint format bench docs clean

help:
	@echo "make demo     train on 1-4 discs, simplify the program, run it with up to 12 and write its page"
	@echo "make test     run the tests"
	@echo "make test-long  run the tests that take minutes: 100 000 random actions on each Panda task"
	@echo "make smoke    compare all nine methods for two minutes, and report"
	@echo "make lint     ruff and mypy;  make format  applies ruff's fixes"
	@echo "make bench    measure speed: training against Stable-Baselines3, environments batched and in processes"
	@echo "make docs     build the documentation into docs/_build/html"
	@echo "make install  install into $(VENV); the other targets do so by themselves"

install: $(INSTALLED)

$(INSTALLED): setup.cfg pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10) and f"Python 3.10 or newer is needed; $(PYTHON) is {sys.version}")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable ".[dev]"
	@touch $@

demo: $(INSTALLED)
	$(ONE_THREAD) $(BIN)/python examples/demo.py

test: $(INSTALLED)
	$(ONE_THREAD) $(BIN)/python -m pytest -n 2

# The smallest comparison of all nine methods, through the code of the large ones, and its report.
smoke: $(INSTALLED)
	rm -rf build/smoke && mkdir -p build/smoke
	$(ONE_THREAD) $(BIN)/progpolicy benchmark run benchmarks/suites/smoke.yml --store build/smoke/results.db --jobs 2
	$(ONE_THREAD) $(BIN)/progpolicy benchmark report build/smoke/results.db -o build/smoke/report

test-long: $(INSTALLED)
	$(ONE_THREAD) $(BIN)/python -m pytest -n 2 -m slow

lint: $(INSTALLED)
	$(BIN)/ruff check $(SOURCES)
	$(BIN)/ruff format --check $(SOURCES)
	$(BIN)/mypy

format: $(INSTALLED)
	$(BIN)/ruff check --fix $(SOURCES)
	$(BIN)/ruff format $(SOURCES)

bench: $(INSTALLED)
	$(ONE_THREAD) $(BIN)/python benchmarks/training_speed.py
	$(ONE_THREAD) $(BIN)/python benchmarks/recurrence.py
	$(ONE_THREAD) $(BIN)/python benchmarks/envs_speed.py
	$(ONE_THREAD) $(BIN)/python benchmarks/panda_speed.py
	$(ONE_THREAD) $(BIN)/python benchmarks/vec_env_speed.py

docs: $(INSTALLED)
	$(BIN)/python -m sphinx -W --keep-going -q docs docs/_build/html
	@echo "docs/_build/html/index.html"

clean:
	rm -rf build docs/_build *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
