# Every target runs from .venv, which the first one makes. Another interpreter: make test PYTHON=python3.12
PYTHON ?= python3
BIN := .venv/bin
INSTALLED := .venv/installed
BENCH ?= performance lips accuracy sensitivity networks finite_strain
FUZZ ?= nifti
SECONDS ?= 60
export HEADS

.PHONY: help demo demo3d paper worked-case steps batch fuzz flips mutations test test-all lint docs bench clean

help:  ## this list
	@sed -n 's/^\([a-z0-9-]*\):.*## /\1\t/p' $(MAKEFILE_LIST) | expand -t 13

# Where the system's Python has no ensurepip, its own pip fills the new environment.
$(INSTALLED): pyproject.toml
	$(PYTHON) -m venv .venv || { $(PYTHON) -m venv --without-pip .venv && $(PYTHON) -m pip --python $(BIN)/python install -q pip; }
	$(BIN)/python -m pip install -q --disable-pip-version-check -e '.[test]'
	touch $@

demo: $(INSTALLED)  ## the paper's experiment on a real MRI slice, with today's defaults
	$(BIN)/xfemnav demo -o out/demo

demo3d: $(INSTALLED)  ## an approach through the whole MNI152 brain, opened by 8 mm: cold and from the cache, seconds and memory
	$(BIN)/python -m benchmarks.demo3d

paper: $(INSTALLED)  ## the same with the paper's own choices: pointwise lips, uniform mesh, topological tip enrichment
	$(BIN)/xfemnav demo -o out/paper --lip-constraint pointwise --corridor-mm 0 --tip-enrichment topological

worked-case: $(INSTALLED)  ## docs/use/worked-case.md: a cut from the brain surface to a tumour on the phantom
	$(BIN)/xfemnav example phantom out/phantom
	$(BIN)/xfemnav run out/phantom/sub-phantom_T1w.nii.gz --cut "58,50.2 25.4,22" --left 2.3,-2.6 --right=-2.3,2.6 -o out/worked-case

steps: $(INSTALLED)  ## docs/use/steps.md: an operation in five steps on a real slice, from one scenario
	$(BIN)/xfemnav example surgery out/surgery
	$(BIN)/xfemnav run --scenario out/surgery/surgery.toml -o out/steps

# GNU make keeps its -j in MAKEFLAGS; the runs are shared out by the command itself, so that one failure stops no other.
batch: $(INSTALLED)  ## make batch IN=folder OUT=folder -j N: every slice of IN that has a <stem>.toml beside it
	$(BIN)/xfemnav batch "$(or $(IN),$(error give IN=folder))" "$(or $(OUT),$(error give OUT=folder))" -j $(or $(patsubst -j%,%,$(filter -j%,$(MAKEFLAGS))),1)

# Two workers share the cores: the linear algebra's own threads would only be in each other's way.
test: $(INSTALLED)  ## the tests that run in minutes
	OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 $(BIN)/python -m pytest -m "not slow" -n 2

test-all: $(INSTALLED)  ## all tests, long batteries too; the independent reference needs gmsh and scikit-fem
	$(BIN)/python -m pip install -q --disable-pip-version-check -e '.[bench]'
	OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 HYPOTHESIS_PROFILE=default $(BIN)/python -m pytest -n 2

fuzz: $(INSTALLED)  ## make fuzz FUZZ=nifti|dicom|markups|scenario|surface|tracts|table|vtu|record SECONDS=600: coverage-guided nonsense
	$(BIN)/python -m pip install -q --disable-pip-version-check atheris
	$(BIN)/python tests/fuzz/fuzz.py $(FUZZ) $(SECONDS)

flips: $(INSTALLED)  ## make flips FORMAT=nii.gz FLIPS=500: bits and bytes of sound files changed at random; without FORMAT all
	$(BIN)/python -m tests.fuzz.flips $(if $(FORMAT),"$(FORMAT)" $(or $(FLIPS),10000),--write)

mutations: $(INSTALLED)  ## make mutations FAULTS="lips cli/": faults planted in a copy, which tests must notice; without FAULTS all
	$(BIN)/python -m benchmarks.mutations $(FAULTS)

lint: $(INSTALLED)  ## ruff
	$(BIN)/ruff check .

docs: demo demo3d worked-case  ## write the generated pages and pictures of docs/ again
	$(BIN)/python -m xfemnav.pipeline.telling.errordocs > docs/reference/errors.md
	$(BIN)/python -m xfemnav.pipeline.telling.scenariodocs > docs/reference/scenario.md
	$(BIN)/python docs/pictures.py

bench: $(INSTALLED)  ## measurements beside other programs and known answers; one of them: make bench BENCH=warp
	$(BIN)/python -m pip install -q --disable-pip-version-check -e '.[bench]'
	set -e; for name in $(BENCH); do echo "== $$name"; $(BIN)/python -m benchmarks.$$name; done

clean:  ## remove what the targets made, the environment too
	rm -rf .venv build out .pytest_cache .ruff_cache .hypothesis *.egg-info
