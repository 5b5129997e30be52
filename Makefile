# Set-up is part of every target: a virtual environment is made and filled on the first run.
PYTHON ?= python3
VENV ?= .venv
BIN = $(VENV)/bin

# Python keeps byte code on disk even where the environment says otherwise: tests start many processes, and each of them
# would compile the source of all packages again.
unexport PYTHONDONTWRITEBYTECODE

PICTURED = fandisk_6475.obj casting.off teapot_utah.obj blub_7106.obj hand_10345.obj bunny_oded_3301.obj

# Of the benchmark of methods: what is published, and what `make benchmark-quick` repeats of it. `field`, of 13 s a reading,
# is left out: it would take an hour of two cores more.
METHODS = keyed eigen host paper local harmonics cho cho-variance radial wang praun
TABLED = asteroid-3k cow bone
OTHERS = box cylinder asteroid-1k creature-1 superquadric-1.5 gem
QUICK = asteroid-3k
QUICK_ATTACKS = 'noise 0.001' 'smoothing 10' 'quantisation 9' 'simplification 0.5' 'isotropic 1' 'bending 10' mirror 'Draco 11'

# Numerical tests, which must hold on any device.
ON_DEVICES = tests/spectral tests/distortion tests/watermark/carriers tests/watermark/reading tests/watermark/test_arrays.py \
	tests/watermark/test_bits.py tests/test_compiling.py tests/test_contract.py tests/test_precision.py tests/test_transformations.py

NOTEBOOKS = $(patsubst notebooks/%.py,docs/notebooks/%.ipynb,$(wildcard notebooks/*.py))

.PHONY: help demo test lint types tests slow-tests long-tests test-device coverage kernels notebooks pictures looks benchmark benchmark-quick docs clean
.DELETE_ON_ERROR:

help:  ## list these commands
	@awk -F ':.*  ## ' '/^[a-z-]+:.*  ## / {printf "%-16s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

demo: $(VENV)/.all  ## mark, attack and read a mesh: make demo [MESH=file]
	$(BIN)/jaxmark demo $(MESH) --output demo-output

test: lint  ## everything that must hold before a change goes in
	@$(MAKE) --no-print-directory --jobs 2 types tests

lint: $(VENV)/.dev  ## ruff: style and formatting
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/.dev  ## pyright: types
	$(BIN)/pyright --pythonpath $(BIN)/python

# Each worker keeps to one thread of BLAS: on small matrices, more of them mostly wait for each other.
tests slow-tests long-tests: export OPENBLAS_NUM_THREADS = 1

tests: $(VENV)/.dev  ## pytest: all tests but the slow and the long ones
	$(BIN)/python -m pytest -q -n auto --dist worksteal --durations=20

slow-tests: $(VENV)/.dev  ## pytest: the slow ones
	$(BIN)/python -m pytest -q -n auto --dist worksteal -m slow

long-tests: $(VENV)/.dev  ## pytest: those of long runs, before a release
	$(BIN)/python -m pytest -q -n auto --dist worksteal -m long

test-device: $(VENV)/.dev  ## pytest: what computes, on whatever device JAX finds
	XLA_PYTHON_CLIENT_PREALLOCATE=false $(BIN)/python -m pytest -q -n auto --dist worksteal -r fEs --tb line $(ON_DEVICES)

coverage: $(VENV)/.dev  ## which lines the tests run; all of it in build/coverage
	$(BIN)/python -m pytest -q -n auto --cov --cov-report=term:skip-covered --cov-report=html

kernels: $(VENV)/.dev  ## compiled filters beside the rest: faster on processors, needs a C++ compiler
	$(BIN)/python -m pip install --quiet ./kernels

notebooks: $(NOTEBOOKS)  ## notebooks with their outputs, as docs/notebooks/*.ipynb

# They share compiled programs with each other and with the tests, see tests/conftest.py.
$(NOTEBOOKS): export JAX_COMPILATION_CACHE_DIR = $(abspath $(VENV))/.programs
$(NOTEBOOKS): export JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS = 0
$(NOTEBOOKS): export OPENBLAS_NUM_THREADS = 1

docs/notebooks/%.ipynb: notebooks/%.py | $(VENV)/.docs
	@echo "running $<, which takes up to two minutes"
	@mkdir -p $(@D)
	@$(BIN)/jupytext --quiet --to ipynb --output $@ --execute --run-path $(@D) $<

pictures: $(VENV)/.all $(NOTEBOOKS)  ## the pictures of README, front page and gallery, where their sources changed
	$(BIN)/python benchmarks/pictures/front.py

looks: $(VENV)/.all  ## the pictures of docs/results/visibility.md, of meshes that are not in the project: make looks MESHES=folder
	$(BIN)/python benchmarks/pictures/looks.py $(addprefix $(MESHES)/,$(PICTURED)) --levels fandisk_6475 bunny_oded_3301

benchmark: $(VENV)/.all  ## the published benchmark of methods anew, half an hour on two cores: docs/results/benchmark*
	$(BIN)/jaxmark bench-corpus build/benchmark/meshes --most-vertices 3000
	$(BIN)/jaxmark bench $(TABLED:%=build/benchmark/meshes/%.ply) --methods $(METHODS) --track smi2010 \
	  --others $(OTHERS:%=build/benchmark/meshes/%.ply) --keys 1 --output build/benchmark/table
	cp build/benchmark/table/results.md docs/results/benchmark_smi2010.md
	cp build/benchmark/table/readings.csv docs/results/benchmark.csv
	$(BIN)/jaxmark bench $(TABLED:%=build/benchmark/meshes/%.ply) --methods $(METHODS) --track 2026 \
	  --others $(OTHERS:%=build/benchmark/meshes/%.ply) --keys 1 --output build/benchmark/table
	cp build/benchmark/table/results.md docs/results/benchmark_2026.md
	tail -n +2 build/benchmark/table/readings.csv >> docs/results/benchmark.csv

benchmark-quick: $(VENV)/.all  ## a part of the published benchmark of methods again, within five minutes, and where it disagrees
	$(BIN)/jaxmark bench-corpus build/benchmark/meshes --most-vertices 3000
	$(BIN)/jaxmark bench $(QUICK:%=build/benchmark/meshes/%.ply) --methods $(METHODS) --track smi2010 2026 \
	  --limits perceptual hidden --attacks none $(QUICK_ATTACKS) --keys 1 --output build/benchmark/quick --against docs/results/benchmark.csv

docs: $(VENV)/.docs $(NOTEBOOKS)  ## all pages, with executed notebooks, in docs/_build/html
	@echo "building the pages, which takes a minute"
	$(BIN)/sphinx-build --quiet --fresh-env --nitpicky --fail-on-warning --keep-going docs docs/_build/html

$(VENV)/.%: pyproject.toml
	@echo "installing into $(VENV), with the extra $*, which takes half a minute"
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --no-compile --editable '.[$*]'
	touch $@

clean:  ## remove what these commands made
	rm -rf $(VENV) demo-output build dist kernels/build docs/_build docs/notebooks docs/reference/api
