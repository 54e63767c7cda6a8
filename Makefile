# Needs Python 3.11 or newer and, the first time, a package index. Everything runs in a virtual environment that
# is made once, by uv where it is there and works, else by pip, and again when pyproject.toml or uv.lock change.
SHELL := bash
.SHELLFLAGS := -euo pipefail -c
.ONESHELL:

VENV := .venv
PYTHON := $(VENV)/bin/python
INSTALLED := $(VENV)/.installed
API := runs/api
DAILY := -m "not slow" -n 2 --dist loadfile --no-loadscope-reorder --max-worker-restart 0
COMPARED := tests/export tests/physics/test_kernels.py
MODULES := $(subst /,.,$(patsubst %.py,%,$(filter-out %__init__.py %__main__.py,$(wildcard clothjax/*.py clothjax/*/*.py))))
CANDIDATES := python3.11 python3.12 python3.13 python3.14 python3 python

.PHONY: quickstart demo docs test test-slow lint types wheel

quickstart: $(INSTALLED)  ## train all stages on the embedded body, evaluate, render, export
	@$(PYTHON) -m experiments.quickstart

demo: $(INSTALLED)  ## a character that you steer, live in the browser
	@$(PYTHON) -m experiments.demo

docs: $(INSTALLED)  ## the reference of the library, made from its docstrings: runs/api/index.html
	@$(PYTHON) -m pdoc --docformat google --output-directory $(API) clothjax $(MODULES)

# Half of a test's time is compilation. What is compared with programs of other compilers is compiled as users do.
test: $(INSTALLED)  ## the tests of every day
	@XLA_FLAGS="--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false $${XLA_FLAGS:-}" \
	    $(PYTHON) -m pytest $(DAILY) $(COMPARED:%=--ignore %)
	$(PYTHON) -m pytest $(DAILY) $(COMPARED)

test-slow: $(INSTALLED)  ## the long ones
	@$(PYTHON) -m pytest -m slow

lint: $(INSTALLED)  ## style
	@$(PYTHON) -m ruff check .
	$(PYTHON) -m ruff format --check .

types: $(INSTALLED)  ## types of the library
	@$(PYTHON) -m pyright --pythonpath $(PYTHON)

wheel: $(INSTALLED)  ## build the wheel, install it elsewhere, and use a garment that comes with it
	@rm -rf dist $(VENV)/wheel
	$(PYTHON) -m build --wheel --outdir dist . > /dev/null
	$(PYTHON) -m zipfile -e dist/*.whl $(VENV)/wheel
	cd $(VENV) && PYTHONPATH=wheel bin/python -c "import clothjax as cj; assert 'wheel' in cj.__file__; print(cj.load('skirt').faces.shape)"

$(INSTALLED): pyproject.toml uv.lock
	@export UV_PROJECT_ENVIRONMENT=$(VENV) UV_PYTHON_DOWNLOADS=never
	if ! { command -v uv >/dev/null && uv sync --frozen --all-extras --no-extra compare; }; then
	    echo "uv is not there or did not succeed: installing with pip"
	    made=
	    for python in $(CANDIDATES); do
	        if "$$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null \
	                && "$$python" -m venv --clear $(VENV); then
	            made=yes
	            break
	        fi
	    done
	    if [ -z "$$made" ]; then
	        echo "no Python 3.11 or newer with its venv module (tried: $(CANDIDATES))" >&2
	        exit 1
	    fi
	    $(PYTHON) -m pip install --disable-pip-version-check --editable '.[data,dev,demo,docs,export,render,sweep]'
	fi
	touch $@
