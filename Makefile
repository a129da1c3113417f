# Everything here sets itself up in .venv first, and skips that when it is done.
PYTHON ?= python3
export PYTHON
BIN := .venv/bin
OUT ?= out/sphere.png

.PHONY: help demo test check notebooks clean

help:
	@echo "make demo        train the sphere on the embedded scene; writes $(OUT), curves and scene"
	@echo "make test        all tests"
	@echo "make check       lint, format, types, layering and the house's limits"
	@echo "make notebooks   execute notebooks/source into notebooks/ (GSPLAT_EDU_BUDGET=reduced for a short run)"
	@echo "make clean       remove .venv, out and caches"

demo:
	@tools/set_up.sh
	@echo "== demo: training the sphere from 24 of its own renders"
	@$(BIN)/gsplat-edu demo --out $(OUT)

test:
	@tools/set_up.sh dev
	@echo "== test: running the suite"
	@$(BIN)/python -m pytest

check:
	@tools/set_up.sh dev
	@echo "== check: ruff, lint"
	@$(BIN)/ruff check .
	@echo "== check: ruff, format"
	@$(BIN)/ruff format --check .
	@echo "== check: mypy, strict over src"
	@$(BIN)/mypy
	@echo "== check: import-linter, who may import whom"
	@$(BIN)/lint-imports
	@echo "== check: the house's limits"
	@$(BIN)/python tools/house_limits.py

notebooks:
	@tools/set_up.sh dev
	@echo "== notebooks: executing notebooks/source"
	@$(BIN)/python tools/build_notebooks.py

clean:
	rm -rf .venv out build dist .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
