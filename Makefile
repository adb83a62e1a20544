# Two commands on a bare machine: `make demo` and `make test`.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
unexport PYTHONDONTWRITEBYTECODE  # modules are compiled once, not by every process that imports them

.PHONY: demo check test test-all docs notebooks written lint types wheel fast unit every fuzz kill study planner speed peers adapters clean

demo: $(VENV)/.runtime  ## train copper_net, compare, open the report (within 5 minutes on 2 cores)
	rm -rf runs/demo
	$(BIN)/cirl demo

check: lint types fast  ## lint, types and the fast tests, in under 2 minutes on 2 cores

test: lint types unit wheel  ## everything that continuous integration needs: what roams over the catalogue is sampled

test-all: lint types every adapters wheel  ## every test with every parameter, and three times the random examples

lint: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/.dev
	$(BIN)/mypy

# two workers have two cores; what the tests of a file share is made in one of them
fast unit every docs notebooks: export OMP_NUM_THREADS = 1

fast: $(VENV)/.dev
	$(BIN)/python -m pytest -q -n 2 --dist loadfile -m 'not slow and not medium' tests

unit: $(VENV)/.dev
	$(BIN)/python -m pytest -q -n 2 --dist loadfile -m 'not slow'

every: $(VENV)/.dev $(VENV)/.docs
	$(BIN)/python -m pytest -q -n 2 --dist loadfile --hypothesis-profile=all

adapters: $(VENV)/.dev  ## contracts and examples of the adapters, each in an environment of its own (some minutes)
	$(BIN)/python tests/adapters/run.py

wheel: $(VENV)/.dev  ## build the wheel and use it from another folder in a clean environment
	rm -rf dist build/clean
	$(BIN)/python -m build --no-isolation --wheel --outdir dist . > /dev/null
	$(BIN)/check-wheel-contents dist
	$(BIN)/python tests/clean.py dist/*.whl build/clean
	$(PYTHON) tests/installed.py build/clean

docs: $(VENV)/.docs  ## the documents as a site in build/site; what is broken or stale ends it (some minutes)
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build

notebooks: $(VENV)/.docs  ## run the notebooks whose scripts have changed and keep what comes out (minutes each)
	$(BIN)/python -m docs.site.notebooks

written: $(VENV)/.runtime  ## the JSON schemas of networks and recipes, docs/format.md and tables of docs/reference.md, from the code
	$(BIN)/python -m docs.site.format_guide
	$(BIN)/python -m docs.site.reference

fuzz: $(VENV)/.dev  ## 10 000 mutated definitions and recipes, each refused or one that works (half an hour)
	$(BIN)/python tests/fuzz.py 10000

kill: $(VENV)/.dev  ## trainings of every kind, killed 100 times at random and taken up again (half an hour)
	$(BIN)/python tests/kill.py 100

study: $(VENV)/.runtime  ## every recipe and controller on every network, against the bound (hours; it can be stopped)
	$(BIN)/python benchmarks/study.py

planner: $(VENV)/.runtime  ## plans for 200 generated networks, and how far they are from the bound (half an hour)
	$(BIN)/python -m benchmarks.yearly

speed: $(VENV)/.runtime  ## table of speed ratios
	$(PIP) install --quiet -c constraints.txt -e '.[benchmarks]'
	$(BIN)/python benchmarks/speed.py

peers: $(VENV)/.runtime  ## RLlib, BenchMARL and TorchRL against ours on copper_net, each in its own environment (an hour)
	$(BIN)/python -m benchmarks.peers.run

$(VENV)/bin/python:
	$(PYTHON) -m venv $(VENV)

$(VENV)/.runtime: pyproject.toml constraints.txt | $(VENV)/bin/python
	$(PIP) install --quiet -c constraints.txt -e .
	touch $@

$(VENV)/.dev: pyproject.toml constraints.txt | $(VENV)/bin/python
	$(PIP) install --quiet --no-compile -c constraints.txt -e '.[dev,human,browser,explain]'
	touch $@ $(VENV)/.runtime

$(VENV)/.docs: pyproject.toml constraints.txt | $(VENV)/bin/python
	$(PIP) install --quiet -c constraints.txt -e '.[docs]'
	touch $@ $(VENV)/.runtime

clean:  ## what these commands made, but for runs
	rm -rf $(VENV) dist build .mypy_cache .ruff_cache .pytest_cache .hypothesis
