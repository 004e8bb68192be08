# Two commands do everything on a fresh Debian or Ubuntu machine: `make demo` and `make test`.
# Set-up is a prerequisite of each, done once, and again when pyproject.toml, constraints.txt or the package list change.
SHELL  := /bin/bash
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
EXTRAS := aravis,harvesters,ur,objects,synthesis,train,console,cluster,docs,dev
OUT    ?= out/demo

.PHONY: demo quick test lint docs clean

demo: $(VENV)/.ready           ## the main job on the simulated lab, about half an hour on two cores
	$(BIN)/s2p3 demo --out $(OUT)

quick: $(VENV)/.ready          ## the same in under five minutes; it shows the way, not the accuracy
	$(BIN)/s2p3 demo --quick --out out/quick

test: $(VENV)/.ready           ## all but the devices' tests side by side, one thread each; then those, one after another
	OMP_NUM_THREADS=1 $(BIN)/pytest -n auto --dist loadfile -m "not devices"
	$(BIN)/pytest -m devices

lint: $(VENV)/.ready
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

docs: $(VENV)/.ready
	$(BIN)/mkdocs build --strict

clean:
	rm -rf $(VENV) build dist site out *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis

$(VENV)/.ready: pyproject.toml constraints.txt tools/system-packages.txt
	PYTHON=$(PYTHON) tools/system-packages.sh
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --upgrade -c constraints.txt -e '.[$(EXTRAS)]'
	touch $@
