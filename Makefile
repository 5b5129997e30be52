# Set-up is part of every target: a virtual environment is made and filled on the first run.
PYTHON ?= python3
VENV ?= .venv
BIN = $(VENV)/bin

.PHONY: demo test lint types tests slow-tests docs clean

demo: $(VENV)/.all  ## mark, attack and read a mesh: make demo [MESH=file]
	$(BIN)/jaxmark demo $(MESH) --output demo-output

test: lint types tests  ## everything that must hold

lint: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/.dev
	$(BIN)/pyright --pythonpath $(BIN)/python

tests: $(VENV)/.dev
	$(BIN)/python -m pytest -q -n auto --durations=20

slow-tests: $(VENV)/.dev
	$(BIN)/python -m pytest -q -n auto -m slow

docs: $(VENV)/.docs  ## all pages, in docs/_build/html
	$(BIN)/sphinx-build --quiet --fresh-env --nitpicky --fail-on-warning --keep-going docs docs/_build/html

$(VENV)/.%: pyproject.toml
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --editable '.[$*]'
	touch $@

clean:
	rm -rf $(VENV) demo-output build dist docs/_build docs/reference/api
