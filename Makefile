# Everything here sets itself up in .venv first, and skips that when it is done.
# PYTHON=python3.12 in front or behind chooses the interpreter; the default is python3.
BIN := .venv/bin
OUT ?= out/sphere.png
# Processes that run the tests: one more than there are cores, because some tests wait for a browser, and at most 4, which
# take up to 1 GiB each. Each test file stays in one process, so that its fixtures are made once; the longest files start
# first (tests/slices.py), so that no process is left with a long one at the end.
WORKERS ?= $(shell n=$$(nproc 2> /dev/null || echo 1); [ $$n -lt 3 ] && echo $$((n + 1)) || echo 4)
# Bytecode is written even where the environment forbids it: the tests start Python a hundred times.
PYTEST := PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder
BIOME := tests/npm/node_modules/@biomejs/biome/bin/biome
BENCH := $(if $(SMOKE),--smoke)
export PYTHON

# The eighth of the long tests that runs: 0 to 7 (tests/slices.py). Without it, `make test` takes that of the commit count
# and `make soak` all. SHARD=none: `make test` runs only those that the change touches. BASE: what the change is compared with.
SHARD ?= $(GSPLAT_EDU_SHARD)
BASE ?= $(GSPLAT_EDU_BASE)
PART ?= cases sanitize neon chapters
export GSPLAT_EDU_SHARD := $(SHARD)
export GSPLAT_EDU_BASE := $(BASE)

.PHONY: help demo test soak check sanitize bench notebooks site wheels clean

help:
	@echo "make demo        train the sphere; writes $(OUT), curves and scene"
	@echo "make test        run all tests; of the sliced ones, the cases that the change touches and an eighth of the others"
	@echo "make soak        every case of the sliced tests, large fuzzing runs, the native tests under sanitizers and on ARM, the full chapters: hours (SHARD=0 to 7: an eighth)"
	@echo "make check       lint, format, types, import layers and size limits"
	@echo "make sanitize    run the native tests on a build with AddressSanitizer and UndefinedBehaviorSanitizer"
	@echo "make bench       benchmarks; prints tables and writes out/bench/*.json (SMOKE=1: only check that they run)"
	@echo "make notebooks   execute notebooks/source into notebooks/ (GSPLAT_EDU_BUDGET=reduced for a short run)"
	@echo "make site        build the site: chapters, documents and reference, out/site/index.html"
	@echo "make wheels      build and check wheels for every platform that this machine can build for: dist/; 10 minutes and more (REPEAT=1: twice, and compare)"
	@echo "make clean       remove .venv, out and caches"

demo:
	@tools/set_up.sh demo
	@echo "== demo: training the sphere from 24 of its own renders"
	@$(BIN)/gsplat-edu demo --out $(OUT)

test:
	@tools/set_up.sh dev
	@echo "== test: running the suite"
	@$(PYTEST)

soak:
	@tools/set_up.sh dev
ifneq ($(filter cases,$(PART)),)
	@echo "== soak: the cases of the sliced tests, $(if $(SHARD),shard $(SHARD),all)"
	@GSPLAT_EDU_SOAK=1 $(PYTEST) -m sliced
endif
ifneq ($(filter sanitize,$(PART)),)
	@echo "== soak: the native tests, damaged checkpoints and configurations under sanitizers"
	@GSPLAT_EDU_SOAK=1 GSPLAT_EDU_SPLIT=all tools/sanitize.sh
endif
ifneq ($(filter neon,$(PART)),)
	@echo "== soak: the native tests on 64-bit ARM, emulated"
	@GSPLAT_EDU_SPLIT=all tools/neon.sh
endif
ifneq ($(filter chapters,$(PART)),)
	@echo "== soak: chapters on the full budget"
	@$(BIN)/python tools/build_notebooks.py --out out/soak/notebooks $(if $(SHARD),--shard $(SHARD))
endif

check:
	@tools/set_up.sh dev
	@echo "== check: ruff, lint"
	@$(BIN)/ruff check .
	@echo "== check: ruff, format"
	@$(BIN)/ruff format --check .
	@echo "== check: clang-format"
	@$(BIN)/clang-format --dry-run --Werror native/*.h native/*.cpp benchmarks/ladder/*.h benchmarks/ladder/*.cpp
	@echo "== check: biome, lint and format of the pages' scripts"
	@if command -v node > /dev/null && [ -f $(BIOME) ]; then node $(BIOME) ci --error-on-warnings; else \
		echo "== check: biome is not installed, the scripts are not checked; install it with: npm ci --prefix tests/npm"; fi
	@echo "== check: mypy, strict over src"
	@$(BIN)/mypy
	@echo "== check: import-linter, who may import whom"
	@$(BIN)/lint-imports
	@echo "== check: the house's limits"
	@$(BIN)/python tools/house_limits.py

sanitize:
	@tools/set_up.sh dev
	@echo "== sanitize: building and testing the native module under sanitizers"
	@tools/sanitize.sh

bench:
	@tools/set_up.sh demo
	@$(BIN)/python benchmarks/raster.py $(BENCH) --out out/bench/raster.json
	@$(BIN)/python benchmarks/sphere.py $(BENCH) --out out/bench/sphere.json
	@$(BIN)/python benchmarks/dense.py $(BENCH) --out out/bench/dense.json
	@$(BIN)/python benchmarks/ladder $(BENCH) --out out/bench/ladder.json
	@$(BIN)/python benchmarks/train_step.py $(BENCH) --out out/bench/train_step.json
	@$(BIN)/python benchmarks/serial.py $(BENCH) --out out/bench/serial.json

notebooks:
	@tools/set_up.sh dev
	@echo "== notebooks: executing notebooks/source"
	@$(BIN)/python tools/build_notebooks.py

site:
	@tools/set_up.sh dev
	@echo "== site: chapters, documents and reference"
	@$(BIN)/python tools/build_site.py

wheels:
	@tools/set_up.sh wheels
	@echo "== wheels: building dist/*.whl"
	@$(BIN)/python tools/build_wheels.py $(if $(TARGETS),--targets $(TARGETS)) $(if $(REPEAT),--repeat)

clean:
	rm -rf .venv out build dist .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
