# Two commands: `make demo` shows it, `make test` proves it. Both set up .venv by themselves.
PYTHON ?= python3
VENV := .venv
STAMP := $(VENV)/.installed
# Pages answer visitors in time: these tests have the machine to themselves.
PAGES := tests/test_ar_browser.py tests/test_scenes_demo.py tests/test_scenes_overlay_page.py tests/test_scenes_fem_worker.py tests/test_scenes_view.py

# The most telling tests: a minute on two cores.
QUICK := house sim_neo_hookean sim_material sim_elasticity sim_plan sim_deformation sim_loads sim_term sim_arguments sim_meshfile scenes_solve \
	sim_readme surrogate_conformal surrogate_store ar_camera ar_rasteriser ar_outlines scenes_tissue_options scenes_outputs

.PHONY: demo quick test test-of test-gpu docs thumbnails lint template locator bench bench-check clean

demo: $(STAMP)
	$(VENV)/bin/sulcus demo

quick: $(STAMP)
	OMP_NUM_THREADS=1 $(VENV)/bin/python -m pytest --numprocesses 2 --dist loadfile $(QUICK:%=tests/test_%.py)

test: $(STAMP)
	OMP_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE= $(VENV)/bin/python -m pytest --numprocesses 2 --dist loadfile \
		--no-loadscope-reorder --durations 15 -rs $(PAGES:%=--ignore=%)
	$(VENV)/bin/python -m pytest -rs $(PAGES)

# Tests of one module: the file of its name, and those that import it. `make test-of FILE=sim/linalg/pcg.py`
MODULE = $(subst /,.,$(basename $(FILE)))
test-of: $(STAMP)
	$(if $(wildcard $(FILE)),,$(error give FILE=PACKAGE/.../MODULE.py))
	OMP_NUM_THREADS=1 $(VENV)/bin/python -m pytest $$( (ls tests/test_$(word 1,$(subst /, ,$(FILE)))_$(notdir $(FILE)) 2>/dev/null; \
		grep -lE "from $(MODULE) import|from $(basename $(MODULE)) import .*\b$(notdir $(basename $(FILE)))\b" tests/test_*.py) | sort -u)

# Those that need a graphics card alone.
test-gpu: $(STAMP)
	OMP_NUM_THREADS=1 $(VENV)/bin/python -m pytest -rs -m gpu

lint: $(STAMP)
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/basedpyright

# The anatomy, its models and its locator that ship with the package. The poses of the spatula take longest: 15 minutes on 32 cores
# with `--device cpu,cpu,...`; all else takes an hour on two cores.
template: $(STAMP)
	$(VENV)/bin/sulcus anatomy --out scenes/data/template.vtu --force
	$(VENV)/bin/sulcus simulate scenes/data/template.vtu --count 5000 --out build/template.h5
	$(VENV)/bin/sulcus train build/template.h5 --learners linear,ann,svr,series,series-gp --most 2000 --out scenes/data/template.model.npz --force
	$(VENV)/bin/sulcus simulate scenes/data/template.vtu --pose-control --tool-preset spatula --blade 12 26 1.5 --count 1000 --out build/gym.h5
	$(VENV)/bin/sulcus train build/gym.h5 --learners contact-gp --out scenes/data/template.gym.npz --force
	$(VENV)/bin/sulcus simulate scenes/data/template.vtu --pose-control --scene spatula --count 640 --out build/spatula.h5
	$(VENV)/bin/sulcus train build/spatula.h5 --learners gp,svr,ann --out scenes/data/template.spatula.npz --force
	$(VENV)/bin/sulcus effects --out scenes/data/template.effects.json
	$(MAKE) locator

# What locates the template's tumour in scenes: up to 13 minutes on two cores.
locator: $(STAMP)
	$(VENV)/bin/sulcus locator scenes/data/template.vtu --small --force

# One measurement, as in `make bench NAME=contact ARGS="--device cpu"`; without NAME, a list of them.
bench: $(STAMP)
	$(VENV)/bin/python -m benchmarks $(or $(NAME),--help) $(ARGS)

# What got slower by more than 10 %: `make bench-check OLD=old.json` measures now, and with NEW=new.json it only compares.
OLD ?= $(word 1,$(filter %.json,$(MAKECMDGOALS)))
NEW ?= $(word 2,$(filter %.json,$(MAKECMDGOALS)))
bench-check: $(STAMP)
	$(if $(OLD),,$(error give OLD=old.json, a record of `python -m benchmarks all`))
	$(VENV)/bin/python -m benchmarks all --against '$(OLD)' $(if $(NEW),--from '$(NEW)',--json build/bench.json)

# The pages for the browser, from docs/: open build/docs/index.html. Warnings are errors.
docs: $(STAMP)
	$(VENV)/bin/python -m sphinx -W --keep-going docs build/docs

# Images of the examples in docs/examples: each script runs. Two minutes on two cores.
thumbnails: $(STAMP)
	CUDA_VISIBLE_DEVICES= MPLBACKEND=agg $(VENV)/bin/python docs/extensions/thumbnails.py $(NAME)

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(VENV)/bin/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev]'
	touch $(STAMP)

clean:
	rm -rf $(VENV) build out docs/generated *.egg-info
