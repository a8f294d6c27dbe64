# `make` alone lists the targets. Everything is installed into .venv from PyPI; nothing else is touched.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STUDY ?= tmt-segments
EXTRAS ?= test,lint,firmware,docs
# The newest Python that is here and runs, and the tests that it runs (all).
NEWEST ?= $(shell for one in python3.14 python3.13 python3.12 $(PYTHON); do \
  $$one -c '' 2>/dev/null && echo $$one && break; done)
TESTS ?=
# Tests wait for workers, too: one process more than there are processors. conftest.py orders their files.
JOBS ?= $(shell echo $$(($$(nproc 2>/dev/null || echo 2) + 1)))
PYTEST := -m pytest -n $(JOBS) --dist loadfile --no-loadscope-reorder
# PoCL links its kernels: a machine without any linker gets one from PyPI.
comma := ,
LINKER := $(shell command -v ld >/dev/null || echo '[linker]')
export PYTHONUNBUFFERED := 1
# Every process that is started would compile the package anew.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: docs help run test test-fast soak fuzz slurm newest lint bench wheel clean
help:
	@echo "make run    run the bundled study $(STUDY) and write its report"
	@echo "make test   run the tests"
	@echo "make test-fast  run a few tests of every room and the recorded numbers of all studies (90 s)"
	@echo "make newest run the tests with the newest Python that is here and the newest of all libraries"
	@echo "make soak   kill campaigns at 200 random moments, simulate 100,000; nothing may be lost (half an hour)"
	@echo "make fuzz   give 2000 damaged files to every reader of files (about five minutes)"
	@echo "make slurm  test campaigns on a Slurm of two nodes on loopback (root, Debian's slurm-wlm and munge)"
	@echo "make lint   ruff and mypy"
	@echo "make bench  run the benchmarks"
	@echo "make docs   build the documentation with tutorials and a gallery of all studies: docs/_site/html"
	@echo "make wheel  build the wheel into dist/"

run: $(VENV)/.run
	@$(BIN)/wavequake run $(STUDY)

test: $(VENV)/.dev
	$(BIN)/python $(PYTEST)

# Quick files of every folder of tests/; a test sees to it that none is left out. Bits of all studies in other
# places, studies under other keys and damaged files for every reader take minutes: `make test` has them.
FAST := test_architecture.py test_recorded_numbers.py \
  chain/test_segment_objects.py contract/test_sources.py drawing/test_ticks.py \
  cluster/test_places.py control/test_linear.py control/test_regulator.py control/test_sensor.py \
  firmware/test_gains_header.py imaging/test_mtf.py imaging/test_detector.py \
  kernels/test_poses.py kernels/test_surfaces.py mechanics/test_linear_system.py mechanics/test_spectra.py \
  optics/test_paraxial.py optics/test_zernike.py optics/test_shape_sag.py reduction/test_krylov.py \
  rare/test_certificate.py report/test_table.py report/test_statistics.py workflows/test_journal.py workflows/test_study.py \
  fuzz/test_fuzz.py viewer/test_film.py

test-fast: $(VENV)/.dev
	$(BIN)/python $(PYTEST) -q -k "not bits_do_not_depend and not variants_of_studies and not damaged_file" $(addprefix tests/,$(FAST))

soak: $(VENV)/.dev
	SOAK_KILLS=$${SOAK_KILLS:-200} SOAK_SEEDS=$${SOAK_SEEDS:-100000} \
	  MANY_RECORDS=1 STOPPED_S=40 $(BIN)/python -m pytest -q -s \
	  tests/workflows/test_soak.py tests/workflows/test_simulation.py \
	  tests/workflows/test_starts.py tests/mechanics/test_telemetry_lines.py \
	  tests/mechanics/test_telemetry_agreement.py tests/rare/test_splitting.py

fuzz: $(VENV)/.dev
	@$(BIN)/python -m pip install -q --disable-pip-version-check -e '.[ansys]' || \
	  echo "The reader of Ansys' files is not installable here; .full is left out."
	$(BIN)/python tests/fuzz/fuzz.py $${FUZZ_FILES:-2000}

slurm: $(VENV)/.dev
	WAVEQUAKE_SLURM=1 $(BIN)/python -m pytest -q -rs tests/workflows/test_slurm.py

newest:
	@$(NEWEST) -m venv --clear $(VENV)-newest
	@$(VENV)-newest/bin/python -m pip install -q --disable-pip-version-check --upgrade \
	  --upgrade-strategy eager -e '.[$(EXTRAS)$(if $(LINKER),$(comma)linker)]'
	$(VENV)-newest/bin/python $(PYTEST) $(TESTS)

lint: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: $(VENV)/.bench
	$(BIN)/python -m benchmarks

docs: $(VENV)/.dev
	$(BIN)/python docs/make_site.py $(STUDIES)
	@echo "Open docs/_site/html/index.html"

wheel: $(VENV)/.dev
	$(BIN)/python -m pip -q wheel --no-deps --wheel-dir dist .

$(VENV)/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || \
	  { echo "Python 3.11 or newer is needed: apt-get install -y python3 python3-venv"; exit 2; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || \
	  { echo "Python's venv module is missing: apt-get install -y python3-venv"; exit 2; }
	@echo "Creating $(VENV) ..."
	@$(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); exit 2; }

$(VENV)/.run: pyproject.toml | $(VENV)/bin/python
	@echo "Installing Wavequake and what it needs from PyPI (about a minute) ..."
	@$(BIN)/python -m pip install -q --disable-pip-version-check -e '.$(LINKER)'
	@touch $@

$(VENV)/.dev: pyproject.toml | $(VENV)/bin/python
	@echo "Installing Wavequake with the tools for tests and lint ..."
	@$(BIN)/python -m pip install -q --disable-pip-version-check -e '.[$(EXTRAS)$(if $(LINKER),$(comma)linker)]'
	@touch $@ $(VENV)/.run

$(VENV)/.bench: pyproject.toml | $(VENV)/bin/python
	@$(BIN)/python -m pip install -q --disable-pip-version-check -e .
	@$(BIN)/python -m pip install -q --disable-pip-version-check -e '.[bench]' || \
	  echo "Some peers are not installable here; the benchmarks skip them."
	@touch $@ $(VENV)/.run

clean:
	rm -rf $(VENV) $(VENV)-newest dist build runs .pytest_cache .mypy_cache .ruff_cache
