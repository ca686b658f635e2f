# `make demo` and `make test` are all that a new machine with Python >= 3.11 needs.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# numba does not see edits in imported files: the tests' cache of compiled kernels is keyed by all sources. `make demo`
# uses the package's own, which `tetopt` keys by the kernels' sources, so that the commands after it compile nothing.
NUMBA_CACHE = $(CURDIR)/.numba_cache/$(shell cat tetopt/*.py tetopt/*/*.py | cksum | cut -d' ' -f1)
# UTF-8, as Python chooses it by itself, but not in the processes that pytest-xdist starts.
TESTED = PYTHONUTF8=1 NUMBA_CACHE_DIR=$(NUMBA_CACHE) MPLBACKEND=agg $(BIN)/python -m pytest
ALL_CORES = -n auto --dist loadfile --no-loadscope-reorder
# Containers forbid Python to keep what it compiled: `tetopt mesh --help` takes 1.3 instead of 0.9 s then.
export PYTHONDONTWRITEBYTECODE =

SOLVERS = calculix-ccx python3-dolfinx

.PHONY: demo check test test-deep test-mutants dist test-lowest test-pythons test-slow test-random test-solvers test-nojit test-onethread test-plain test-bounds test-hostile test-container test-cohort lint bench measured fingerprints docs clean

demo: $(VENV)/.demo
	$(BIN)/tetopt demo -o demo --force

# Between edits: units, laws, twins, one whole run of each command.
check: $(VENV)/.test
	NUMBA_CACHE_DIR=$(NUMBA_CACHE) $(BIN)/tetopt warm-up
	$(TESTED) -q -m "not (full or deep or slow)" $(ALL_CORES)

# All behaviour that users meet.
test: $(VENV)/.test
	NUMBA_CACHE_DIR=$(NUMBA_CACHE) $(BIN)/tetopt warm-up
	$(TESTED) -m "not (deep or slow)" $(ALL_CORES)

# Processes and faults, and the kernels in other modes: what `.ci/run` runs beside `make test`.
test-deep: $(VENV)/.test
	NUMBA_CACHE_DIR=$(NUMBA_CACHE) $(BIN)/tetopt warm-up
	$(TESTED) -q -m "deep and not slow" $(ALL_CORES)
	$(MAKE) --no-print-directory -j 2 test-onethread test-nojit

# Whether tests see the faults of tests/mutants, two at a time: about an hour.
test-mutants: $(VENV)/.test
	NUMBA_CACHE_DIR=$(NUMBA_CACHE) $(BIN)/python tests/mutants/run.py --jobs 2

# The small cases again on one thread, and with the kernels run as plain Python; no other file is read for that.
KERNEL_TESTS = $(shell grep -rl --include='test_*.py' 'mark\.kernel' tests)
test-onethread: $(VENV)/.test
	NUMBA_NUM_THREADS=1 $(TESTED) -q -m kernel --no-header --durations=3 $(KERNEL_TESTS)

test-nojit: $(VENV)/.test
	NUMBA_DISABLE_JIT=1 $(TESTED) -q -m kernel --no-header --durations=3 $(KERNEL_TESTS)

# The same without the internals of numba.
test-plain: $(VENV)/.test
	TETOPT_PLAIN_NUMBA=1 $(TESTED) -q -m kernel --no-header --durations=3 $(KERNEL_TESTS)
	TETOPT_PLAIN_NUMBA=1 $(TESTED) -q -m "not slow" --no-header --durations=3 tests/test_kernels.py

# The same, and a run of each kind, stopped here and there, with each index of compiled code checked: none that lies
# beyond its array is survived. Negative ones count from the end there as in numpy, and are not seen.
test-bounds: export NUMBA_BOUNDSCHECK = 1
test-bounds: $(VENV)/.test
	NUMBA_CACHE_DIR=$(NUMBA_CACHE) $(BIN)/tetopt warm-up
	$(TESTED) -q -m kernel --no-header --durations=3 $(KERNEL_TESTS)
	$(TESTED) -q -m "not slow" --no-header --durations=3 tests/engine/test_ended_early.py tests/test_any_mesh.py tests/test_kernels.py

# The wheel and the archive of sources, into dist/: checked, each installed into a fresh environment, and run there.
dist: $(VENV)/bin/python
	$(BIN)/python .ci/dist.py dist

# The suite with the lowest versions of all packages that pyproject.toml allows, in an environment of its own.
LOWEST = .venv-lowest
test-lowest:
	$(PYTHON) -m venv $(LOWEST)
	$(LOWEST)/bin/python -m pip install --quiet --disable-pip-version-check uv
	$(LOWEST)/bin/python -m uv pip install --quiet --python $(LOWEST)/bin/python --resolution lowest-direct -e ".[test]"
	NUMBA_CACHE_DIR=$(NUMBA_CACHE)-lowest $(LOWEST)/bin/tetopt warm-up
	PYTHONUTF8=1 NUMBA_CACHE_DIR=$(NUMBA_CACHE)-lowest MPLBACKEND=agg \
	  $(LOWEST)/bin/python -m pytest -m "not slow" $(ALL_CORES)

# The README's commands with Debian's own Pythons, 3.13 and the newest, each in a bare root, as root: half an hour.
test-pythons:
	bash .ci/pythons

# A million random operations of the engine, 500 random whole runs and 500 of labels by the defaults, two hours.
test-random: $(VENV)/.test
	NUMBA_CACHE_DIR=$(NUMBA_CACHE) $(BIN)/python benchmarks/random/runs.py --seed 1 --runs 500
	NUMBA_CACHE_DIR=$(NUMBA_CACHE) $(BIN)/python benchmarks/random/runs.py --seed 1 --runs 500 --labelled
	NUMBA_CACHE_DIR=$(NUMBA_CACHE) $(BIN)/python benchmarks/random/operations.py --seed 1 --operations 1000000

test-slow: $(VENV)/.test
	$(TESTED) -m slow

# 10,000 hostile inputs, of the seed in HOSTILE_SEED; `.ci/run` has 40. What ended badly is kept, and its folder printed.
test-hostile: $(VENV)/.test
	PYTHONPATH=scripts PYTHONUTF8=1 NUMBA_CACHE_DIR=$(NUMBA_CACHE) $(BIN)/python -m fuzz --inputs 10000 --workers 2
	$(TESTED) -q -s --no-header tests/hostile/test_faults.py tests/hostile/test_kills.py

# CalculiX and dolfinx from Debian, MFEM and gmsh (run beside the tests, never imported by tetopt) from PyPI.
test-solvers: $(VENV)/.test
	@command -v apt-get >/dev/null || { echo "needs Debian's apt-get; install CalculiX (ccx) and dolfinx, then run: $(BIN)/python -m pytest tests/solvers"; exit 2; }
	dpkg -s $(SOLVERS) >/dev/null 2>&1 || { apt-get update -qq && apt-get install -y -qq --no-install-recommends $(SOLVERS); }
	$(BIN)/python -m pip install --quiet --disable-pip-version-check mfem gmsh
	$(TESTED) tests/solvers tests/model tests/io/test_abaqus.py tests/io/test_febio.py tests/io/test_gmsh.py \
	  tests/io/test_medit.py tests/io/test_mfem.py tests/io/test_vtk.py tests/io/test_xdmf.py tests/io/test_writers.py

# The Dockerfile's steps as a script in a fresh environment, and its entry point as another user; needs root.
test-container: $(VENV)/.test
	$(TESTED) -q -m "slow or not slow" --no-header tests/test_container.py

# Two hundred subjects with failures put in, the client killed on the way: a quarter of an hour on two idle cores.
test-cohort: $(VENV)/.test
	NUMBA_CACHE_DIR=$(NUMBA_CACHE) $(BIN)/tetopt warm-up
	NUMBA_CACHE_DIR=$(NUMBA_CACHE) $(BIN)/python benchmarks/cohort_campaign.py

# The site, into docs/_build/html, without the network; warnings are errors. The gallery's programs run, for minutes.
docs: $(VENV)/.test
	rm -rf docs/_build docs/reference/api/generated
	NUMBA_CACHE_DIR=$(NUMBA_CACHE) $(BIN)/tetopt warm-up
	NUMBA_CACHE_DIR=$(NUMBA_CACHE) PYTHONUTF8=1 $(BIN)/python -m sphinx -W --keep-going -q -b html -d docs/_build/doctrees docs docs/_build/html
	$(BIN)/python docs/check_site.py docs/_build/html
	@echo "docs/_build/html/index.html"

lint: $(VENV)/.test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

bench: $(VENV)/.test
	NUMBA_CACHE_DIR=$(NUMBA_CACHE) $(BIN)/python scripts/benchmark.py -o bench.json --force
	NUMBA_CACHE_DIR=$(NUMBA_CACHE) $(BIN)/python benchmarks/benchmark_kernels.py -o bench_kernels.json --force
	NUMBA_CACHE_DIR=$(NUMBA_CACHE) $(BIN)/tetopt warm-up

# Every number of docs/measured and of README's table, and these pages: 1.5 hours. DATA is a folder with the images that
# scripts/measure.py names; PEERS are its options for CGAL, whose programs docs/howto/own_mesher.md describes.
measured: $(VENV)/.test
	NUMBA_CACHE_DIR=$(NUMBA_CACHE) $(BIN)/tetopt warm-up
	NUMBA_CACHE_DIR=$(NUMBA_CACHE) $(BIN)/python scripts/measure.py $(DATA) $(PEERS)

# Whether meshes are still those of the version that wrote tests/fingerprints.json, to the last bit.
fingerprints: $(VENV)/.test
	PYTHONPATH=scripts NUMBA_CACHE_DIR=$(NUMBA_CACHE) $(BIN)/python benchmarks/fingerprints.py -o fingerprints.json --against tests/fingerprints.json --force

$(VENV)/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "tetopt needs Python >= 3.11; name one with: make PYTHON=python3.12"; exit 2; }
	$(PYTHON) -m venv $(VENV)

$(VENV)/.demo: $(VENV)/bin/python pyproject.toml
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e . "nilearn>=0.10.4"
	@touch $@

$(VENV)/.test: $(VENV)/bin/python pyproject.toml
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e ".[test]"
	@touch $@

clean:
	rm -rf $(VENV) $(LOWEST) dist .numba_cache demo measured docs/_build docs/gallery bench.json bench_kernels.json bench_blocks.json fingerprints.json
