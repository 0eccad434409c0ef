# make demo | test | check | bench | page | install       PYTHON=/path/to/python3 to choose the interpreter (3.11 or newer)

PYTHON ?= python3
BIN := .venv/bin
DEMO := demo

.PHONY: help install demo test check bench signatures page clean

help:
	@echo "make demo     simulate a small recording, refine it, and compare with the truth (minutes)"
	@echo "make test     all tests"
	@echo "make check    lint, formatting, types, layering; lint of deploy/"
	@echo "make bench    speed and memory, into docs/benchmarks.md"
	@echo "make signatures  which kernels are compiled ahead, anew, after a change of their arguments"
	@echo "make page     the page of the job service anew, into service/page, after a change in service/page_src"
	@echo "make install  lvba in .venv, and nothing else"

install: .venv/.installed-simulate,laz

.venv/.installed-%: pyproject.toml deploy/setup.sh
	@sh deploy/setup.sh "$(PYTHON)" "$*"
	@touch $@

demo: install
	@$(BIN)/python -m service.cli.demo $(DEMO)

test: .venv/.installed-dev
	$(BIN)/python -m pytest $(PYTEST)

check: .venv/.installed-dev
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/check-jsonschema --quiet --builtin-schema vendor.citation-file-format CITATION.cff
	PATH="$(CURDIR)/$(BIN):$$PATH" sh deploy/check.sh

bench: .venv/.installed-dev
	$(BIN)/python benchmarks/bench.py $(BENCH)

signatures: .venv/.installed-dev
	$(BIN)/python -m service.cli.kernel_signatures

page: .venv/.installed-page
	$(BIN)/python service/page_src/build.py

clean:
	rm -rf .venv $(DEMO) build *.egg-info
