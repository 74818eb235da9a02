# From a fresh checkout: `make demo`, or `make test`. Each makes .venv first.
# Needed before that: Python 3.11 or newer, make, a C compiler.

VENV ?= .venv
PYTHON ?= $(firstword $(foreach p,python3.11 python3.12 python3.13 python3,$(shell command -v $(p) 2>/dev/null)))
# Quoted wherever a path may hold a space; targets are relative, since make splits names at spaces.
BIN := $(VENV)/bin
ABSOLUTE_BIN := "$(if $(filter /%,$(VENV)),$(VENV),$(CURDIR)/$(VENV))/bin"
LAYOUT := build/layout
LEROBOT := build/lerobot
# One process for each core, each with one thread: more would take the cores from each other.
# Tests of a file stay together, with what they share.
PYTEST := OMP_NUM_THREADS=1 $(BIN)/pytest --numprocesses auto --dist loadfile
# pip refuses an editable install where a hash is asked for.
VERSIONS := build/constraints.txt
INSTALL := $(BIN)/pip install --constraint $(VERSIONS) --editable
# pip's own line installs a hook of import, which editors and type checkers do not run.
POINT_TO_LAYOUT = $(MAKE) --no-print-directory layout && for site in $(VENV)/lib/python*/site-packages; do echo "$(CURDIR)/$(LAYOUT)" > "$$site/dmrl_layout.pth"; done
# Tests start many processes. Without bytecode on disk each would compile every module again.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help int8 bench bench-scale bench-labels reliability demo test test-heavy test-all test-lerobot test-faults mutants golden check format lint types imports spell schemas constraints docs pictures site examples wheels layout clean

help: ## Show this list.
	@sed -n 's/^\([a-z-]*\):[^#]*## /\1\t/p' $(MAKEFILE_LIST) | expand -t 12

demo: $(VENV)/.demo ## Run the whole pipeline, small; pictures and a table end up in demo/.
	$(BIN)/dmrl demo --out demo

test: $(VENV)/.dev ## Run the tests, but for those below. ARGS="-k name" picks some.
	$(PYTEST) $(ARGS)

test-heavy: $(VENV)/.dev ## Run the tests that take a tenth of a second of CPU or more.
	$(PYTEST) -m "heavy and not slow" $(ARGS)

test-all: $(VENV)/.dev ## Run every test, those too that take minutes.
	$(PYTEST) -m "slow or not slow" --timeout 3600 $(ARGS)

bench: $(VENV)/.dev ## Time dmrl beside others, on flights it makes: build/bench/. ARGS="--only predict".
	$(BIN)/pip install --quiet --group bench
	$(BIN)/python benchmarks/bench_all.py build/bench $(ARGS)

bench-scale: $(VENV)/.dev ## Time long recordings and thousands of them, for an hour or more: build/bench/.
	@mkdir -p build/bench
	$(BIN)/python benchmarks/bench_columns.py --messages 10000000
	$(BIN)/python benchmarks/bench_items.py
	$(BIN)/python benchmarks/bench_many.py
	$(BIN)/python benchmarks/bench_growth.py --seconds 10 --times 1 10 100 --json build/bench/scale.json --plot build/bench/growth.png

bench-labels: $(VENV)/.dev ## Judge labels, sound and with faults: build/judge/. ARGS="--sets sound --flights 2".
	$(BIN)/python benchmarks/bench_label_judge.py build/judge $(ARGS)

mutants: $(VENV)/.dev ## Change the code a little, often; see if tests notice. ARGS="geometry --seed 1".
	$(BIN)/python tests/mutants.py $(ARGS)

test-lerobot: export DMRL_LEROBOT_PYTHON = $(LEROBOT)/bin/python
test-lerobot: $(VENV)/.dev $(LEROBOT)/.installed ## Read a dataset written for LeRobot by lerobot itself, in its own environment (8 GB).
	$(PYTEST) --numprocesses 0 -m heavy tests/exchange -k lerobot $(ARGS)

$(LEROBOT)/.installed:
	python3 -m venv $(LEROBOT)
	$(LEROBOT)/bin/pip install --quiet lerobot==0.4.4
	touch $@

test-faults: $(VENV)/.dev ## Break disks, processes and files in every way; prints what came of it.
	$(PYTEST) -m "slow or not slow" --timeout 3600 tests/faults tests/recording/test_flips.py tests/recording/test_renames.py tests/recording/test_budgets.py tests/formats/test_fuzz.py $(ARGS)

reliability: export DMRL_FAULTS_PAGE = docs/reliability.md
reliability: test-faults ## Run test-faults, and write the table of docs/reliability.md.

golden: $(VENV)/.dev ## Compare the decoded outputs of the main commands with tests/golden.json.
	$(BIN)/python tests/golden.py $(ARGS)

check: format lint types imports spell ## Check format, lint, types, imports and spelling.

format: $(VENV)/.dev ## Check that the code is formatted.
	$(BIN)/ruff format --check .

lint: $(VENV)/.dev ## Look for mistakes that a linter finds.
	$(BIN)/ruff check .

types: $(VENV)/.dev layout ## Check types, strictly.
	cd $(LAYOUT) && $(ABSOLUTE_BIN)/mypy --config-file "$(CURDIR)/pyproject.toml"

imports: $(VENV)/.dev layout ## Check that imports go down only.
	cd $(LAYOUT) && $(ABSOLUTE_BIN)/lint-imports --config "$(CURDIR)/pyproject.toml"

spell: $(VENV)/.dev ## Check spelling.
	$(BIN)/codespell

int8: $(VENV)/.dev ## Quantise the shipped networks again. ARGS="published.mcap" adds images that set ranges.
	$(BIN)/python benchmarks/ship_int8.py $(ARGS)

schemas: $(VENV)/.dev ## Build the message classes again from schemas/dmrl/v1/*.proto.
	$(BIN)/python schemas/build.py

constraints: $(VENV)/.dev ## Renew the versions and hashes of constraints.txt. ARGS="--upgrade-package numpy".
	$(BIN)/pip install --quiet uv
	@sed -n '/^#/!q;p' constraints.txt > build/pins
	$(BIN)/uv pip compile pyproject.toml --all-extras --group dev --universal --python-version 3.11.7 \
	  --generate-hashes --no-annotate --no-header --quiet $(or $(ARGS),--upgrade) --output-file constraints.txt
	@{ cat build/pins; echo; cat constraints.txt; } > build/pins.all && mv build/pins.all constraints.txt

docs: $(VENV)/.dev ## Write the generated parts of README.md and docs/ again.
	$(BIN)/python docs/build.py

pictures: $(VENV)/.dev ## Draw the pictures of README.md and docs/ again. ARGS="--data DIR".
	$(BIN)/python docs/pictures.py $(ARGS)

site: $(VENV)/.dev ## Build the pages of docs/ as a site: build/site/index.html.
	$(BIN)/mkdocs build --quiet

examples: $(VENV)/.dev ## Run the examples, scripts and notebooks.
	$(PYTEST) -m "slow or not slow" --timeout 900 tests/test_examples.py $(ARGS)

wheels: $(VENV)/.dev ## Build wheel and sdist, check them, install them clean, work with them.
	.ci/wheels

clean: ## Remove what was built, .venv and demo/ as well.
	rm -rf $(VENV) build demo *.egg-info

# viewer/, schemas/ and recipes/ are imported as dmrl.viewer and so on. Tools that read the
# source without importing it see them there only in a tree laid out as it is installed. The
# installation points to it, so that editors and type checkers resolve `import dmrl`.
layout:
	@mkdir -p $(LAYOUT)/dmrl
	@for place in $(LAYOUT)/dmrl/*; do test -e "$$place" || rm -f "$$place"; done
	@for place in dmrl/* viewer schemas recipes; do ln -sfn "$(CURDIR)/$$place" "$(LAYOUT)/dmrl/$$(basename "$$place")"; done

$(VENV)/.pip:
	@test -n "$(PYTHON)" || { echo "dmrl needs Python 3.11 or newer; none was found" >&2; exit 1; }
	@$(PYTHON) -c 'import sys; sys.version_info >= (3, 11) or sys.exit("dmrl needs Python 3.11 or newer. Try: make PYTHON=/path/to/python3.11")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --upgrade 'pip>=25.1'
	@touch $@

$(VERSIONS): constraints.txt
	@mkdir -p $(@D)
	@sed -e '/--hash/d' -e 's/ *\\$$//' $< > $@

# So an editor resolves every import of examples and pages.
$(VENV)/.demo: $(VENV)/.pip pyproject.toml $(VERSIONS)
	$(INSTALL) '.[train,label,view,plot,ros]' --group examples
	@$(POINT_TO_LAYOUT)
	@touch $@

$(VENV)/.dev: $(VENV)/.pip pyproject.toml $(VERSIONS)
	$(INSTALL) '.[all]' --group dev
	@$(POINT_TO_LAYOUT)
	@touch $(VENV)/.demo $@
