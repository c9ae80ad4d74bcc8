# Needs make and Python >= 3.10; everything else is installed into .venv.
PYTHON ?= python3
VENV ?= .venv
BIN = $(VENV)/bin
# Stamps of the package with what it needs to run, and of the development tools on top
RUNNABLE = $(VENV)/.runnable
INSTALLED = $(VENV)/.installed
SOURCES = sb3_have tests benchmarks notebooks
# One torch thread a process: the two test processes would otherwise fight over the cores.
PYTEST = OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2

.PHONY: demo study-quick test docs lint format type commit-checks install clean

demo: $(RUNNABLE)
	$(BIN)/python -m sb3_have.demo

# Does the algorithm still estimate values as it should? A few minutes; fails if a formula is broken.
study-quick: $(INSTALLED)
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.study_quick

test: $(INSTALLED)
	$(PYTEST) $(ARGS)

lint: $(INSTALLED)
	$(BIN)/ruff check $(SOURCES)
	$(BIN)/ruff format --check $(SOURCES)

docs: $(INSTALLED)
	$(BIN)/python -m sphinx -W --keep-going -b html docs docs/_build/html

format: $(INSTALLED)
	$(BIN)/ruff check --fix $(SOURCES)
	$(BIN)/ruff format $(SOURCES)

type: $(INSTALLED)
	$(BIN)/mypy

commit-checks: format type lint

install: $(INSTALLED)

# A stamp is written last, so an interrupted installation is taken up again.
$(RUNNABLE): setup.cfg pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10) and "Python >= 3.10 is needed, found " + sys.version.split()[0] + " (make PYTHON=python3.11 ...)")'
	test -x $(BIN)/pip || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install -c constraints.txt -e .
	@touch $@

$(INSTALLED): $(RUNNABLE)
	$(BIN)/python -m pip install -c constraints.txt -e ".[dev]"
	@touch $@

clean:
	rm -rf $(VENV) build dist docs/_build *.egg-info .mypy_cache .pytest_cache .ruff_cache
	find $(SOURCES) -type d -name __pycache__ -prune -exec rm -rf {} +
