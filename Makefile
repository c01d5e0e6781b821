# Two commands on a fresh machine: `make demo` (the main job) and `make test` (every test).
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin

.PHONY: demo test clean

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)

demo: $(BIN)/python
	$(BIN)/pip install -q -c constraints.txt .
	$(BIN)/python train.py

test: $(BIN)/python
	$(BIN)/pip install -q -c constraints.txt '.[test]'
	$(BIN)/python -m pytest -q

clean:
	rm -rf $(VENV) build demo .pytest_cache
