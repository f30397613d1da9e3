# Each target makes what it needs, once. From nothing: Python 3.11 and an internet connection or package mirror.
PYTHON ?= python3.11
BACKEND := .venv/bin/python
BPY := .venv-blender/bin/python
BLENDER ?= blender
DEMO := build/demo

.PHONY: help demo test test-blender check benchmark quick ablation scaling points extension screenshots
.DELETE_ON_ERROR:

help:
	@echo "make demo    render 6 views of a scene, reconstruct it, measure the error"
	@echo "make test    run all tests"
	@echo "make check   style and types"
	@echo "make extension   the zip to install in Blender"
	@echo "make test-blender BLENDER=blender   the add-on's tests in a real Blender"
	@echo "make screenshots BLENDER=blender    the pictures of the add-on in docs/images"
	@echo "make benchmark SUITE=quick   speed against error: table and plot; also scenes, sides, parts, photos; BUDGETS=\"10 20\"; RECORD=docs/results"
	@echo "make quick     the suite quick, and whether its numbers are within bounds"
	@echo "make ablation CASES=\"monkey_3 plaster_6\"   what each part is worth; SEEDS=3 for medians"
	@echo "make points    surfaces from points alone beside screened Poisson"
	@echo "make scaling   how time and memory grow with views, pixels and the grid"

demo: .venv/.ready $(DEMO)/scene/transforms.json
	$(BACKEND) -m backend reconstruct $(DEMO)/scene/images --cameras $(DEMO)/scene/transforms.json \
	    --truth $(DEMO)/scene/truth.ply --output $(DEMO)/result

$(DEMO)/scene/transforms.json: .venv-blender/.ready $(wildcard blender_scenes/*.py)
	rm -rf $(DEMO)/result  # of the views before: the backend would not replace it
	$(BPY) -m blender_scenes.render_views --scene monkey --views 6 --layout arc --arc-deg 120 \
	    --output $(DEMO)/scene

# Blender's Python has no jaxtyping: its tests run without the shape checks of pyproject.toml.
BLENDER_TESTS := -o addopts="--strict-markers --import-mode=importlib" tests/blender

# Two at a time: most tests use one core.
test: .venv/.ready .venv-blender/.ready
	$(BACKEND) -m pytest --ignore=tests/blender --numprocesses 2 --dist worksteal
	FEWVIEW_PYTHON=$(abspath $(BACKEND)) $(BPY) -m pytest $(BLENDER_TESTS)

# A Blender with settings of its own: the tests install the extension, and must not touch the user's.
# BLENDER may be several words; what it needs to be told is in the environment.
SETTINGS := build/blender-settings
IN_BLENDER = FEWVIEW_PYTHON=$(abspath $(BACKEND)) BLENDER_USER_RESOURCES=$(abspath $(SETTINGS)) $(BLENDER)

test-blender: .venv/.ready build/pytest/.ready
	rm -rf $(SETTINGS) && mkdir -p $(SETTINGS)
	$(IN_BLENDER) --background --factory-startup --python-exit-code 1 \
	    --python tests/blender/run_in_blender.py -- build/pytest $(TESTS)

extension: .venv-blender/.ready
	$(BPY) tests/blender/build_extension.py --output build

screenshots: .venv/.ready extension
	rm -rf $(SETTINGS) && mkdir -p $(SETTINGS)
	$(IN_BLENDER) --command extension install-file --repo user_default --enable build/fewview-*.zip
	$(IN_BLENDER) --factory-startup --python docs/take_screenshots.py -- --output docs/images

build/pytest/.ready: .venv-blender/.ready
	$(BPY) -m pip install --quiet --constraint constraints-blender.txt --target build/pytest pytest
	@touch $@

check: .venv/.ready
	$(BACKEND) -m ruff check
	$(BACKEND) -m ruff format --check
	$(BACKEND) -m mypy
	@# The add-on is a package inside the extension, whose name is that of a folder: here a link to this one.
	mkdir -p build/types && ln -sfn ../.. build/types/fewview
	MYPYPATH=build/types $(BACKEND) -m mypy --package fewview.addon
	@# And as on other systems, with a cache for each: in one for all each would be read anew every time.
	for platform in win32 darwin; do \
	    $(BACKEND) -m mypy --platform $$platform --cache-dir .mypy_cache/$$platform || exit 1; \
	    MYPYPATH=build/types $(BACKEND) -m mypy --platform $$platform --cache-dir .mypy_cache/$$platform \
	        --package fewview.addon || exit 1; \
	done

BENCHMARK := build/benchmark
SUITE ?= quick
SEEDS ?= $(if $(filter quick,$(SUITE)),1,3)
# Seconds for fitting the surface, to measure each preset with as well: BUDGETS="10 20 40 80 160".
BUDGETS ?=
# Others than the presets in use: PRESETS="neus sparsecraft nerf", with ONLY_BUDGETS=1 where they take long without one.
PRESETS ?= fast balanced
ONLY_BUDGETS ?=
# A folder for a record that is kept with the code: RECORD=docs/results.
RECORD ?=
DATA ?= $(wildcard ../shared/data)

# Renders what is missing or out of date, then measures what is not known yet or has changed.
benchmark: .venv/.ready .venv-blender/.ready
	$(BPY) -m benchmarks.render_scenes $(SUITE) --output $(BENCHMARK)/rendered $(if $(DATA),--data $(DATA))
	$(BACKEND) -m backend benchmark $(SUITE) --output $(BENCHMARK)/$(SUITE) --seeds $(SEEDS) --presets $(PRESETS) \
	    $(if $(BUDGETS),--budgets $(BUDGETS)) $(if $(ONLY_BUDGETS),--only-budgets) \
	    $(if $(RECORD),--record $(RECORD)) \
	    --scenes $(BENCHMARK)/rendered $(if $(DATA),--photos $(DATA))

# For CI: the suite `quick`, its numbers within loose bounds.
quick:
	$(MAKE) --no-print-directory benchmark SUITE=quick
	$(BACKEND) -m benchmarks.within_bounds $(BENCHMARK)/quick/results.json

CASES ?= monkey_3 plaster_6

ablation: .venv/.ready .venv-blender/.ready
	$(BPY) -m benchmarks.render_scenes --cases $(CASES) --output $(BENCHMARK)/rendered $(if $(DATA),--data $(DATA))
	$(BACKEND) -m benchmarks.ablation --cases $(CASES) --seeds $(SEEDS) --output $(BENCHMARK)/ablation \
	    $(if $(RECORD),--record $(RECORD)) \
	    --scenes $(BENCHMARK)/rendered $(if $(DATA),--photos $(DATA))

scaling: .venv/.ready .venv-blender/.ready
	$(BPY) -m benchmarks.render_scenes --cases monkey_12 --output $(BENCHMARK)/rendered
	$(BACKEND) -m benchmarks.scaling --case monkey_12 --output $(BENCHMARK)/scaling --scenes $(BENCHMARK)/rendered

points: .venv/.ready
	$(if $(DATA),,$(error clouds are needed: make points DATA=FOLDER))
	$(BACKEND) -m benchmarks.points --data $(DATA) --output $(BENCHMARK)/points \
	    $(if $(RECORD),--record $(RECORD))

.venv/.ready: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BACKEND) -m pip install --quiet --constraint constraints.txt ".[dev]"
	@touch $@

.venv-blender/.ready: constraints-blender.txt
	$(PYTHON) -m venv .venv-blender
	$(BPY) -m pip install --quiet --constraint constraints-blender.txt bpy pytest
	@touch $@
