# Every target needs an environment in .venv, which grows with what is asked for: `make demo` and `make serve` install the
# service and the simulator, the others add what tests and training need. Nothing is installed again until pyproject.toml
# or constraints.txt changes.
#
#   make demo     clear a few tables through the service; leaves demo-report/report.html
#   make serve    start the service on port 8000     make bench    speed tables
#   make test     run the tests                      make check    lint, types, walls between packages
#   make format   rewrite files in the one style     make audit    pinned versions against published advisories
#   make mutants  put small faults into the code and list those that no test notices; under an hour on two cores
#
# Variables:
#   PYTHON=python3.11       interpreter for the environment (3.10 or 3.11: PyBullet has no wheels for later ones)
#   TORCH_INDEX_URL=URL     index for PyTorch alone, for example its CPU wheels: https://download.pytorch.org/whl/cpu
#   PYTEST_ARGS="..."       more arguments for pytest, for example -k pose
#   MUTANTS_ARGS="..."      arguments of `python -m bench.mutants`, for example --packages training --seed 1

PYTHON ?= python3.11
VENV ?= .venv
TORCH_INDEX_URL ?=
TEST_WORKERS ?= 2
PYTEST_ARGS ?=
MUTANTS_ARGS ?=
DEMO_ROUNDS ?= 3
DEMO_SCENE ?= packed

BIN := $(VENV)/bin
TO_RUN := $(VENV)/.to-run
TO_DEVELOP := $(VENV)/.to-develop
PIP_INSTALL := $(BIN)/python -m pip install --constraint constraints.txt

.PHONY: demo test check format serve bench audit mutants clean
.DELETE_ON_ERROR:

demo: $(TO_RUN)
	rm -rf demo-report
	$(BIN)/python -m simharness --rounds $(DEMO_ROUNDS) --scene $(DEMO_SCENE) --seed 0 --out demo-report
	@echo
	@echo "The report with pictures: open demo-report/report.html in a browser."
	@echo "The viewer: make serve, then http://127.0.0.1:8000/viewer shows a cloud and its grasps."

test: $(TO_DEVELOP)
	$(BIN)/python -m pytest -n $(TEST_WORKERS) --dist loadfile $(PYTEST_ARGS)

check: $(TO_DEVELOP)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: $(TO_DEVELOP)
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

serve: $(TO_RUN)
	$(BIN)/python -m service

bench: $(TO_DEVELOP)
	$(BIN)/python -m bench.predict
	$(BIN)/python -m bench.serve

audit: $(TO_DEVELOP)
	.ci/audit $(BIN)/python

mutants: $(TO_DEVELOP)
	$(BIN)/python -m bench.mutants --workers $(TEST_WORKERS) $(MUTANTS_ARGS)

# PyTorch comes first and alone: an index of CPU wheels must not answer for anything else, its dependencies included.
$(TO_RUN): pyproject.toml constraints.txt
	@command -v $(PYTHON) >/dev/null || { echo "$(PYTHON) is missing; apt-get install python3.11 python3.11-venv, or name another: make PYTHON=..." >&2; exit 1; }
	@$(PYTHON) -c 'import sys; v = sys.version_info[:2]; sys.exit(0 if v in ((3, 10), (3, 11)) else "$(PYTHON) is Python %d.%d; PyBullet has wheels for 3.10 and 3.11: make PYTHON=python3.11" % v)'
	@$(BIN)/python -m pip --version >/dev/null 2>&1 || $(PYTHON) -m venv $(VENV) || { echo "no environment could be made; on Debian: apt-get install python3.11-venv" >&2; exit 1; }
	$(PIP_INSTALL) --no-deps $(if $(TORCH_INDEX_URL),--index-url $(TORCH_INDEX_URL)) torch
	$(PIP_INSTALL) --editable '.[service,sim]'
	touch $@

$(TO_DEVELOP): $(TO_RUN)
	$(PIP_INSTALL) --editable '.[all]'
	touch $@

clean:
	rm -rf $(VENV) build demo-report *.egg-info
