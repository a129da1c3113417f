# Everything here sets itself up in .venv first, and skips that when it is done.
# PYTHON=python3.12 in front or behind chooses the interpreter; the default is python3.
BIN := .venv/bin
OUT ?= out/sphere.png
# Processes that run the tests: one more than there are cores, because some tests wait for a browser, and at most 4, which
# take up to 1 GiB each. Each test file stays in one process, so that its fixtures are made once.
WORKERS ?= $(shell n=$$(nproc 2> /dev/null || echo 1); [ $$n -lt 3 ] && echo $$((n + 1)) || echo 4)
# Bytecode is written even where the environment forbids it: the tests start Python a hundred times.
PYTEST := PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -n $(WORKERS) --dist loadfile
BIOME := tests/npm/node_modules/@biomejs/biome/bin/biome
BENCH := $(if $(SMOKE),--smoke)
export PYTHON

# The parts of `make soak`, and the seed of its fuzzers.
PART ?= cases sanitize neon chapters wheels
SEED ?= $(shell date +%s)
# The tests that `make stress` repeats, and how often.
FILES ?= tests
ROUNDS ?= 10

.PHONY: help demo course test test-slow stress soak check sanitize bench notebooks site book slides wheels clean

help:
	@echo "make demo        train the sphere; writes $(OUT), curves and scene"
	@echo "make course      open the chapters in JupyterLab (JUPYTER=--no-browser: print its address only)"
	@echo "make test        every test without a browser and without a whole training: the first tier"
	@echo "make test-slow   the second tier: browser journeys, whole trainings, poses of photos, kills, the site, chapters, sanitizers"
	@echo "make stress      repeat the tests of the second tier (FILES=...) ten times (ROUNDS=...) with slow tabs beside eight busy processes"
	@echo "make soak        large fuzzing runs, sanitizers and ARM, the full chapters, wheels: hours; before a release (PART=...: one of them)"
	@echo "make check       lint, format, types, import layers and size limits"
	@echo "make sanitize    run the native tests on a build with AddressSanitizer and UndefinedBehaviorSanitizer"
	@echo "make bench       benchmarks; prints tables and writes out/bench/*.json (SMOKE=1: only check that they run)"
	@echo "make notebooks   execute notebooks/source into notebooks/ (GSPLAT_EDU_BUDGET=reduced for a short run)"
	@echo "make site        build the site: chapters, documents and reference, out/site/index.html"
	@echo "make book        build the course as EPUB, and as PDF if Chromium is installed: out/book"
	@echo "make slides      build slides of each chapter: out/slides"
	@echo "make wheels      build and check wheels for every platform that this machine can build for: dist/; 10 minutes and more (REPEAT=1: twice, and compare)"
	@echo "make clean       remove .venv, out and caches"

demo:
	@tools/set_up.sh demo
	@echo "== demo: training the sphere from 24 of its own renders"
	@$(BIN)/gsplat-edu demo --out $(OUT)

course:
	@tools/set_up.sh course
	@echo "== course: JupyterLab with the first chapter; Ctrl+C twice ends it"
	@$(BIN)/jupyter lab --LabApp.default_url=/lab/tree/notebooks/01_points.ipynb $(JUPYTER)

test:
	@tools/set_up.sh dev
	@echo "== test: the first tier"
	@$(PYTEST) -m "not slow"

# The first tier checks shapes and dtypes; the second calls the functions as users do, in two thirds of a training's time.
test-slow: sanitize
	@echo "== test-slow: the second tier"
	@JAXTYPING_DISABLE=1 $(PYTEST) -m slow

stress:
	@tools/set_up.sh dev
	@echo "== stress: $(ROUNDS) rounds of $(FILES)"
	@JAXTYPING_DISABLE=1 tools/stress.sh $(ROUNDS) $(PYTEST) -m slow $(FILES)

soak:
	@tools/set_up.sh dev
ifneq ($(filter cases,$(PART)),)
	@echo "== soak: fuzzers and the tests of soaks, seed $(SEED)"
	@GSPLAT_EDU_SOAK=1 GSPLAT_EDU_SEED=$(SEED) $(PYTEST) -m "soak or fuzz"
endif
ifneq ($(filter sanitize,$(PART)),)
	@echo "== soak: the native tests, damaged checkpoints and configurations under sanitizers, seed $(SEED)"
	@GSPLAT_EDU_SOAK=1 GSPLAT_EDU_SEED=$(SEED) tools/sanitize.sh
endif
ifneq ($(filter neon,$(PART)),)
	@echo "== soak: the native tests on 64-bit ARM, emulated"
	@tools/neon.sh
endif
ifneq ($(filter chapters,$(PART)),)
	@echo "== soak: chapters on the full budget"
	@$(BIN)/python course/build_notebooks.py --out out/soak/notebooks
endif
ifneq ($(filter wheels,$(PART)),)
	@$(MAKE) wheels REPEAT=1
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
	@$(BIN)/python benchmarks/sphere.py $(BENCH) --out out/bench/sphere.json
	@$(BIN)/python benchmarks/dense.py $(BENCH) --out out/bench/dense.json
	@$(BIN)/python benchmarks/ladder $(BENCH) --out out/bench/ladder.json
	@$(BIN)/python benchmarks/train_step.py $(BENCH) --out out/bench/train_step.json

notebooks:
	@tools/set_up.sh dev
	@echo "== notebooks: executing notebooks/source"
	@$(BIN)/python course/build_notebooks.py

site:
	@tools/set_up.sh dev
	@echo "== site: chapters, documents and reference"
	@$(BIN)/python course/build_site.py

book:
	@tools/set_up.sh dev
	@echo "== book: the course as EPUB and PDF"
	@$(BIN)/python course/build_book.py

slides:
	@tools/set_up.sh dev
	@$(BIN)/python course/build_slides.py

wheels:
	@tools/set_up.sh wheels
	@echo "== wheels: building dist/*.whl"
	@$(BIN)/python tools/build_wheels.py $(if $(TARGETS),--targets $(TARGETS)) $(if $(REPEAT),--repeat)

clean:
	rm -rf .venv out build dist .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
