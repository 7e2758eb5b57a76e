# Every target makes its own environment in .venv first, and keeps it until pyproject.toml or constraints.txt changes.
#
#   make demo     clear a few tables through the service; leaves demo-report/report.html
#   make test     run the tests                      make check    lint, types, walls between packages
#   make serve    start the service on port 8000     make bench    speed tables
#   make format   rewrite files in the one style     make audit    pinned versions against published advisories
#
# Variables:
#   PYTHON=python3.11       interpreter for the environment (3.10 or 3.11: PyBullet has no wheels for later ones)
#   TORCH_INDEX_URL=URL     index for PyTorch alone, for example its CPU wheels: https://download.pytorch.org/whl/cpu
#   PYTEST_ARGS="..."       more arguments for pytest, for example -k pose

PYTHON ?= python3.11
VENV ?= .venv
TORCH_INDEX_URL ?=
TEST_WORKERS ?= 2
PYTEST_ARGS ?=
DEMO_ROUNDS ?= 3
DEMO_SCENE ?= packed

BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
PIP_INSTALL := $(BIN)/python -m pip install --constraint constraints.txt

.PHONY: demo test check format serve bench audit clean
.DELETE_ON_ERROR:

demo: $(INSTALLED)
	rm -rf demo-report
	$(BIN)/python -m simharness --rounds $(DEMO_ROUNDS) --scene $(DEMO_SCENE) --seed 0 --out demo-report
	@echo "The report with pictures: demo-report/report.html"

test: $(INSTALLED)
	$(BIN)/python -m pytest -n $(TEST_WORKERS) --dist loadfile $(PYTEST_ARGS)

check: $(INSTALLED)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: $(INSTALLED)
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

serve: $(INSTALLED)
	$(BIN)/python -m service

bench: $(INSTALLED)
	$(BIN)/python -m bench.predict
	$(BIN)/python -m bench.serve

audit: $(INSTALLED)
	.ci/audit $(BIN)/python

# PyTorch comes first and alone: an index of CPU wheels must not answer for anything else, its dependencies included.
$(INSTALLED): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; v = sys.version_info[:2]; sys.exit(0 if v in ((3, 10), (3, 11)) else "$(PYTHON) is Python %d.%d; PyBullet has wheels for 3.10 and 3.11: make PYTHON=python3.11" % v)'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(PIP_INSTALL) --no-deps $(if $(TORCH_INDEX_URL),--index-url $(TORCH_INDEX_URL)) torch
	$(PIP_INSTALL) --editable '.[all]'
	touch $@

clean:
	rm -rf $(VENV) build demo-report *.egg-info
