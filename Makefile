# Everything happens in .venv, which the first target that needs it makes: Python 3.11 or newer and make are enough.
PYTHON ?= python3
VENV := .venv
PEERS := .venv-peers
MAPS := tests/web/maps
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

export PIP_DISABLE_PIP_VERSION_CHECK := 1

.DEFAULT_GOAL := help
.PHONY: help demo docs site kernels page check test test-rest cover test-web bench-web test-lowest sanitize portable torture lint format bench bench-peers bench-server bench-stream wheels release-rehearsal image-check clean

help: ## this list
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## /\1\t/' | expand -t 14

demo: kernels ## stream a million points over a slow link, stop early, and show what came
	@$(BIN)/lodestream demo $(ARGS)

docs: $(STAMP) ## build the documentation site into build/docs; a link that leads nowhere is an error
	@$(BIN)/python -P -c 'import furo, myst_parser, sphinx' 2>/dev/null || $(BIN)/python -m pip install --quiet --group docs
	@$(BIN)/python .ci/docs.py build/docs

site: page kernels docs $(MAPS)/node_modules/.package-lock.json ## write build/site for any host of files: the documentation, and the public demo in its folder demo
	@rm -rf build/site build/map && cp -R build/docs build/site
	@cd $(WEB) && npm run --silent build:library -- --outDir $(CURDIR)/build/map --logLevel error
	@cp $(WEB)/examples/map.html $(addprefix $(MAPS)/node_modules/maplibre-gl/dist/maplibre-gl,.css .mjs -worker.mjs) build/map
	@$(BIN)/python -m lodestream_client.demo.site build/site/demo build/map

# The tests start many processes: none is to compile every module again, whatever the shell's environment says. Four
# of pytest's share two processors, since some of the tests wait for a clock. Threads of OpenBLAS would wait for each
# other there, and keep a processor busy meanwhile.
TESTED := PYTHONDONTWRITEBYTECODE= OPENBLAS_NUM_THREADS=1
PYTEST := -m pytest -q -n 4 --dist loadfile
COVERAGE := build/coverage

test: kernels ## run the tests; ARGS="-k name" for some of them; COVER=1 as cover does
ifdef COVER
	@rm -rf $(COVERAGE) && mkdir -p $(COVERAGE)
	@$(TESTED) $(BIN)/coverage run $(PYTEST) $(ARGS)
	@$(BIN)/coverage combine --quiet && $(BIN)/coverage report
else
	@$(TESTED) $(BIN)/python $(PYTEST) $(ARGS)
endif

test-rest: kernels ## run what `make test` leaves out: the other cases of its sweeps, and long tests, with samples of their cases
	@HYPOTHESIS_PROFILE=rest $(TESTED) $(BIN)/python $(PYTEST) $(ARGS)

cover: ## run the tests and say which lines of Python none of them runs, in whatever process
	@$(MAKE) --no-print-directory test COVER=1

# Rules and tables, the protocol, the client's core, what the pages say. It leaves out all that takes long: codec and
# formats but for examples, whole streams, the server but for its settings, faults, kernels.
CHECKED := tests/test_doctests.py $(wildcard tests/core/test_*_docs.py) tests/core/test_public.py \
	tests/core/test_target.py tests/core/test_text.py tests/core/test_quality.py tests/core/protocol \
	tests/core/container/test_format_docs.py tests/core/container/test_index_pages.py tests/core/planning/test_byte_ranges.py \
	tests/core/grid/test_axis.py tests/client/stream/test_core.py tests/client/commands/test_arguments.py

check: lint kernels ## lint and a subset of the tests: about a minute
	@$(TESTED) $(BIN)/python $(PYTEST) $(CHECKED)

test-lowest: ## run the tests with the oldest versions that pyproject.toml allows
	@$(PYTHON) .ci/lowest.py build/lowest $(ARGS)

sanitize: kernels ## run tests of the kernels under sanitizers, count their lines, call each with anything; ARGS="--seconds 600"
	@$(BIN)/python -m tests.kernels.sanitize $(ARGS)

portable: kernels ## compare the kernels' bits from gcc, clang and zig, and on imitated machines, with whatever is there
	@$(BIN)/python -m tests.kernels.portable --zig $(ARGS)

torture: kernels ## what takes too long for every run, into docs/reliability.md; ARGS="--seconds 300" or "kills fuzz"
	@$(BIN)/python -c 'import atheris' 2>/dev/null || $(BIN)/python -m pip install --quiet --group torture || true
	@$(BIN)/python -m tests.torture $(ARGS)

# Compiled when Lodestream is installed, and again whenever their sources change.
kernels: $(STAMP)
	@$(BIN)/python core/kernels/build.py

# The page of the browser, of which server and client serve the built files: see client/web/README.md.
WEB := client/web
PAGE := core/lodestream/page/static
WEB_TOOLS := $(VENV)/.web
WEB_SOURCES := $(shell find $(WEB)/src $(WEB)/kernels $(WEB)/scripts -type f -not -name module.ts 2>/dev/null) \
	$(wildcard $(WEB)/*.json $(WEB)/*.ts core/kernels/*.[ch])

page: $(PAGE)/index.html ## build the page of the browser (Node 20 or newer), which servers and `lodestream open` show

# Both wait for links and clocks much of the time, so they run at the same time.
test-web: page $(WEB_TOOLS) $(MAPS)/node_modules/.package-lock.json ## test the npm package in Node, and the page in Chromium; ARGS="-k name" for some of the latter
	@cd $(WEB) && npm run --silent check && PYTHON=$(CURDIR)/$(BIN)/python npm test --silent
	@LODESTREAM_WEB=1 $(TESTED) $(BIN)/python -m pytest -q -n 2 --dist loadfile tests/web $(ARGS)

bench-web: page $(WEB_TOOLS) ## speed of the browser's decoder, times to the first picture, and the size of the bundle
	@$(BIN)/python -m benchmarks.web $(ARGS)

$(PAGE)/index.html: $(WEB)/node_modules/.package-lock.json $(WEB_SOURCES) | $(WEB_TOOLS)
	@cd $(WEB) && PYTHON=$(CURDIR)/$(BIN)/python npm run --silent kernels && npm run --silent build:page
	@rm -rf $(PAGE) && cp -R $(WEB)/dist/page $(PAGE) && touch $@

# MapLibre, which only tests and the public demo open, and CesiumJS, which only tests do.
$(MAPS)/node_modules/.package-lock.json: $(MAPS)/package-lock.json
	@cd $(MAPS) && npm install --no-save --silent --no-audit --no-fund && touch $(CURDIR)/$@

# The compiler of the kernels, and what drives Chromium.
$(WEB_TOOLS): $(STAMP)
	@$(BIN)/python -m pip install --quiet --group web
	@touch $@

# Not `npm ci`: that refuses where a registry lacks what a package has for another platform. The versions are the lock file's.
$(WEB)/node_modules/.package-lock.json: $(WEB)/package-lock.json | $(STAMP)
	@command -v npm > /dev/null || { echo "The page is built with Node 20 or newer, and npm: there is none" >&2; exit 1; }
	@cd $(WEB) && npm install --no-save --silent --no-audit --no-fund

C := $(wildcard core/kernels/*.[ch] tests/kernels/*.[ch])
LAID_OUT := $(C) $(wildcard client/web/kernels/*.[ch])
CLANG_FORMAT := $(BIN)/clang-format --style=file:core/kernels/.clang-format
C_WARNINGS := -std=c11 -O2 -ffp-contract=off -Wall -Wextra -Wconversion -Werror -DLODE_SOURCES='"lint"' -Icore/kernels

# mypy takes about as long as all the others, each on one processor.
lint: $(STAMP) ## ruff, mypy --strict, which package may import which, clang-format, warnings of gcc and clang, workflows; lines of code
	@status=0; said=$$(mktemp); \
	$(BIN)/mypy > $$said 2>&1 & types=$$!; \
	for check in "ruff check" "ruff format --check" "lint-imports --no-logo"; do $(BIN)/$$check || status=1; done; \
	$(CLANG_FORMAT) --dry-run -Werror $(LAID_OUT) || status=1; \
	$(BIN)/check-jsonschema --builtin-schema vendor.github-workflows .github/workflows/*.yml || status=1; \
	$(BIN)/check-jsonschema --builtin-schema vendor.compose-spec docker/compose.yaml docker/compose.scale.yaml || status=1; \
	for compiler in gcc clang; do \
		if command -v $$compiler > /dev/null; then \
			for file in $(filter %.c,$(C)); do $$compiler $(C_WARNINGS) -c $$file -o /dev/null || status=1; done; \
		else \
			echo "lint: there is no $$compiler, so nobody has seen its warnings"; \
		fi; \
	done; \
	$(BIN)/python .ci/lines.py; \
	wait $$types || status=1; \
	cat $$said; rm -f $$said; \
	exit $$status

format: $(STAMP) ## let ruff lay out the code and sort its imports, and clang-format lay out the C
	@$(BIN)/ruff check --quiet --select I --fix
	@$(BIN)/ruff format --quiet
	@$(CLANG_FORMAT) -i $(LAID_OUT)

bench: kernels ## measure speed, memory and bytes on this machine; ARGS="transform solver" for some of them
	@$(BIN)/python -m benchmarks $(ARGS)

bench-peers: $(PEERS)/.installed ## compare bytes, speed and memory with other coders; ARGS="--only ours" or "--tables"
	@$(PEERS)/bin/python core/kernels/build.py
	@$(PEERS)/bin/python -m benchmarks.peers $(ARGS)

bench-server: kernels ## 500 streams at once from one server, beside Range; ARGS="--streams 100"
	@$(BIN)/python -m benchmarks.server $(ARGS)

bench-stream: kernels ## what comes after a stop, and times to the first and to good pictures, over slow and distant links
	@$(BIN)/python -m benchmarks.stream

wheels: page ## build and check dist/: wheels for Linux, macOS and Windows, and the source distribution
	@$(BIN)/python -P -c 'import auditwheel, build, lief' 2>/dev/null || $(BIN)/python -m pip install --quiet --group wheels
	@$(BIN)/python .ci/wheels.py dist

release-rehearsal: page ## build all that a release has into dist/, and try it in empty environments; publishes nothing
	@$(BIN)/python -P -c 'import auditwheel, build, lief, twine' 2>/dev/null || $(BIN)/python -m pip install --quiet --group wheels
	@PATH="$(CURDIR)/$(BIN):$$PATH" PYTHON=$(CURDIR)/$(BIN)/python $(BIN)/python .ci/rehearse.py dist

image-check: ## run every step of docker/Dockerfile in an empty Debian root, and stream from its server; as root, with debootstrap
	@$(PYTHON) .ci/image.py build

clean: ## remove the environment and everything else that can be made again
	rm -rf $(VENV) $(PEERS) build dist core/lodestream/native $(PAGE) $(WEB)/node_modules $(WEB)/dist $(WEB)/src/kernels/module.ts .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# The stamp is written last, so an installation that was interrupted is taken up again by the next make.
$(STAMP): pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "Lodestream needs Python 3.11 or newer; name one with PYTHON=, e.g. make PYTHON=python3.12 $(MAKECMDGOALS)" >&2; exit 1; }
	@echo "Installing into $(VENV); this happens once and takes a minute or two" >&2
	@$(PYTHON) -m venv $(VENV)
	@$(BIN)/python -m pip install --quiet --upgrade 'pip>=25.1'
	@$(BIN)/python -m pip install --quiet --editable '.[all]' --group dev
	@touch $@

# An environment of its own: nothing else needs what it needs. The newest peers need Python 3.12 or newer, so one is
# looked for, also among pyenv's (whose commands of that name may refuse to run), unless PYTHON= names another.
NEWER = $(if $(filter file,$(origin PYTHON)),$(shell \
	for python in python3.13 python3.12 $(foreach v,3.13 3.12,$(wildcard $(HOME)/.pyenv/versions/$v.*/bin/python)); do \
		if $$python -c 'import venv' 2> /dev/null; then echo $$python; break; fi; \
	done))
$(PEERS)/.installed: pyproject.toml benchmarks/peers/requirements.txt
	@echo "Installing into $(PEERS); this happens once and takes a minute or two" >&2
	@$(or $(NEWER),$(PYTHON)) -m venv --clear $(PEERS)
	@$(PEERS)/bin/python -m pip install --quiet --upgrade 'pip>=25.1'
	@$(PEERS)/bin/python -m pip install --quiet --editable '.[server,formats]' --requirement benchmarks/peers/requirements.txt
	@touch $@
