# The verbs of daily work; each is one line that also works without make.
#   make setup   install everything into .venv            make format  let ruff rewrite the code
#   make run     a quick ladder, or ARGS="train ..."       make check   format, lint, types, pins
#   make test    the fast tests                            make lock    renew the pins from pyproject.toml
#   make slow    the slow tests                           make bench   speed of every world, or ARGS="--quick"

PYTHON ?= python3
ARGS ?= ladder --budget quick

.PHONY: setup run test slow bench check format lock

setup:
	@$(PYTHON) start.py setup

run:
	@$(PYTHON) start.py $(ARGS)

test:
	@$(PYTHON) start.py test

slow:
	@$(PYTHON) start.py test -m slow

bench: ARGS =
bench: setup
	@.venv/bin/python scripts/benchmark.py $(ARGS)

check:
	@$(PYTHON) start.py check

format: setup
	@.venv/bin/ruff format .
	@.venv/bin/ruff check --fix .

lock:
	@$(PYTHON) start.py lock
