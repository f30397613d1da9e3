# Each target makes what it needs, once. From nothing: Python 3.11 and an internet connection or package mirror.
PYTHON ?= python3.11
BACKEND := .venv/bin/python
BLENDER := .venv-blender/bin/python
DEMO := build/demo

.PHONY: help demo test check benchmark
.DELETE_ON_ERROR:

help:
	@echo "make demo    render 6 views of a scene, reconstruct it, measure the error"
	@echo "make test    run all tests"
	@echo "make check   style and types"
	@echo "make benchmark   speed against error, as a table"

demo: .venv/.ready $(DEMO)/scene/transforms.json
	$(BACKEND) -m backend reconstruct $(DEMO)/scene/images --cameras $(DEMO)/scene/transforms.json \
	    --truth $(DEMO)/scene/truth.ply --output $(DEMO)/result

$(DEMO)/scene/transforms.json: .venv-blender/.ready $(wildcard blender_scenes/*.py)
	$(BLENDER) -m blender_scenes.render_views --scene monkey --views 6 --layout arc --arc-deg 120 \
	    --output $(DEMO)/scene

test: .venv/.ready .venv-blender/.ready
	$(BACKEND) -m pytest --ignore=tests/blender
	@# Blender's Python has no jaxtyping: its tests run without the shape checks of pyproject.toml.
	$(BLENDER) -m pytest -o addopts="--strict-markers --import-mode=importlib" tests/blender

check: .venv/.ready
	$(BACKEND) -m ruff check
	$(BACKEND) -m ruff format --check
	$(BACKEND) -m mypy

BENCHMARK := build/benchmark
SCENES := $(addprefix $(BENCHMARK)/scenes/,monkey_3 monkey_6 plaster_6)
PHOTOS ?= $(wildcard ../shared/data)

benchmark: .venv/.ready $(addsuffix /transforms.json,$(SCENES))
	$(BACKEND) benchmarks/measure.py --scenes $(BENCHMARK)/scenes --output $(BENCHMARK) \
	    $(if $(PHOTOS),--photos $(PHOTOS))

# A scene's folder is its name and its number of views: three are taken over 40 degrees, six over 120.
$(BENCHMARK)/scenes/%/transforms.json: .venv-blender/.ready $(wildcard blender_scenes/*.py)
	$(BLENDER) -m blender_scenes.render_views --scene $(firstword $(subst _, ,$*)) \
	    --views $(lastword $(subst _, ,$*)) --layout arc \
	    --arc-deg $(if $(filter 3,$(lastword $(subst _, ,$*))),40,120) --output $(@D)

.venv/.ready: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BACKEND) -m pip install --quiet --constraint constraints.txt ".[dev]"
	@touch $@

.venv-blender/.ready: constraints-blender.txt
	$(PYTHON) -m venv .venv-blender
	$(BLENDER) -m pip install --quiet --constraint constraints-blender.txt bpy pytest
	@touch $@
