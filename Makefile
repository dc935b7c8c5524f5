PYTHON ?= python3
VENV   ?= .venv
OUT    ?= out
BIN    := $(VENV)/bin
READY  := $(VENV)/.ready
PROFILE ?= quick
RESOLUTION ?= lowest-direct

.DEFAULT_GOAL := help
.PHONY: help setup reproduce test test-slow lint types package docs benchmark evidence clean attack audit ends

help:            ## list the targets
	@grep -hE '^[a-z-]+: .*##' $(MAKEFILE_LIST) | sed 's/:.*## /\t/' | expand -t 14

setup: $(READY)  ## make the environment in .venv

$(READY): pyproject.toml constraints.txt
	@echo "[setup] creating $(VENV) and installing forcegp (once; a few minutes)"
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@$(BIN)/python -m pip install --upgrade --progress-bar off --quiet "pip>=24"
	@echo "[setup] PyTorch"
	@$(BIN)/python -m pip install --progress-bar off --quiet -c constraints.txt torch
	@echo "[setup] forcegp and the tools that test it"
	@$(BIN)/python -m pip install --progress-bar off --quiet -c constraints.txt -e ".[mujoco,pybullet,sweep,test,dev,docs]"
	@touch $(READY)
	@echo "[setup] done"

reproduce: $(READY)  ## the main job: simulate, select, train, report
	$(BIN)/python -m reproduction --profile $(PROFILE) --out $(OUT)/$(PROFILE)
	@echo "[reproduce] open $(OUT)/$(PROFILE)/report.html"

test: lint types $(READY)  ## lint, types and tests but for slow ones
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist worksteal -m "not slow"
	@echo "[test] all passed: lint, types and the tests summed up above; the slow ones: make test-slow"

test-slow: $(READY)  ## the slow tests, which continuous integration runs too
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist worksteal -m slow
	@echo "[test-slow] all passed"

lint: $(READY)   ## ruff, order of imports, texts
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	PYTHONPATH=. $(BIN)/lint-imports --no-cache --no-logo
	$(BIN)/python .ci/texts.py

package: $(READY)  ## build the wheel and try it in an environment of its own
	sh .ci/wheel $(BIN)/python

docs: $(READY)   ## the documentation site; runs the code of every page
	OMP_NUM_THREADS=1 $(BIN)/python -m sphinx --jobs 2 --fail-on-warning --keep-going --quiet docs $(OUT)/docs
	@echo "[docs] open $(OUT)/docs/index.html"

types: $(READY)  ## pyright
	$(BIN)/pyright

benchmark: $(READY)  ## run times and separation of forces, as JSON under out/benchmarks
	@mkdir -p $(OUT)/benchmarks
	@for name in dynamics inference rollout separation; do \
	  echo "[benchmark] $$name"; $(BIN)/python benchmarks/$$name.py --json $(OUT)/benchmarks/$$name.json || exit 1; \
	done
	@echo "[benchmark] results are in $(OUT)/benchmarks"

evidence: $(READY) ## the benchmarks of docs/evidence.md, and its tables (hours)
	OMP_NUM_THREADS=1 PYTHONPATH=. $(BIN)/python benchmarks/evidence.py --folder $(OUT)/evidence

audit: $(READY)  ## known vulnerabilities of the installed packages, where the advisory service answers
	@$(BIN)/python -m pip install --quiet -c constraints.txt pip-audit || echo "[audit] pip-audit cannot be installed"
	@sh .ci/audit $(BIN)/python

ends:            ## tests with the lowest versions allowed, or with RESOLUTION=highest the newest
	sh .ci/ends $(PYTHON) $(RESOLUTION)

attack: $(READY) ## 20,000 inputs per reader, faults at every step, 50 kills per command, types of every call (hours)
	@$(BIN)/python -m pip install --quiet "atheris>=3; python_version >= '3.11'" || echo "[attack] without atheris"
	PYTHONPATH=src $(BIN)/python fuzz/attack.py --inputs 20000 --engine mutate
	PYTHONPATH=src $(BIN)/python fuzz/attack.py --inputs 20000
	FORCEGP_ATTACK=1 OMP_NUM_THREADS=1 $(BIN)/python -m pytest tests/faults tests/robot/test_fuzz.py
	FORCEGP_CHECKED=1 OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist worksteal -m "not slow"
	@echo "[attack] no findings"

clean:           ## remove what the targets made
	rm -rf $(VENV) $(OUT) build dist .pytest_cache .ruff_cache
