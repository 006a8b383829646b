# Two commands: `make report` runs the main job on the embedded data, `make test` passes the tests.
# Both set everything up in .venv first and reuse it afterwards.
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
BENCH_VENV := .venv-bench
OUT ?= out/he2019
# Small matrices: threads of the linear algebra would only wait for each other.
export OPENBLAS_NUM_THREADS ?= 1

.PHONY: report reference test test-slow coverage browser crates docs bench rivals lint format install-check release-check clean

report: $(READY)
	$(BIN)/calib report --out $(OUT) --overwrite

# The committed numbers of the main job, and the pictures that README and docs show. Made again only when numbers move.
reference: $(READY) report
	$(BIN)/calib report --out reports/he2019 --overwrite --no-views
	cp $(OUT)/figures/drawbar_pull_bands.png $(OUT)/figures/gap_nominal_slip.png docs/pictures/

# Tests that share what they sample stay in one process (tests/together.py). Compiled once: to write
# their assertions out takes each process six seconds.
test: export PYTHONDONTWRITEBYTECODE :=
test: $(READY)
	$(BIN)/python -m pytest -n auto --dist loadfile --no-loadscope-reorder

test-slow: $(READY)
	$(BIN)/python -m pytest -m slow

# Lines and branches of calib that the tests of `make test` run, in every process that they start.
coverage: export COVERAGE_FILE := $(CURDIR)/out/coverage/data
coverage: $(READY)
	rm -rf out/coverage && mkdir -p out/coverage
	$(BIN)/python -m coverage run -m pytest -n auto --dist loadfile
	$(BIN)/python -m coverage combine -q
	$(BIN)/python -m coverage report --skip-covered

# What tests open pages in, and what looks at them there; they are left out without. As root, on Debian.
browser:
	@command -v chromium chromedriver >/dev/null || \
	  { apt-get update -qq && apt-get install -yqq chromium chromium-driver >/dev/null; }
	@npm install --no-save --no-package-lock --no-audit --no-fund --silent axe-core@4.14.1

# What accepts research objects, in an environment of its own: it needs another rich. Tests with it are left out without.
crates: $(READY)
	@test -x .venv-crates/bin/rocrate-validator || { $(BIN)/python -m venv --clear .venv-crates && \
	  .venv-crates/bin/python -m pip install --quiet --disable-pip-version-check roc-validator==0.13.0; }

# Static pages in out/docs, made from docs/ and the declarations; warnings are errors.
docs: $(VENV)/.docs
	$(BIN)/python -m sphinx -W --keep-going -q -b html -d out/.doctrees docs out/docs
	@echo out/docs/index.html

# Against the peers, written to reports/benchmarks; PART="posterior likelihood" does a part of it.
# The everyday commands have no peers and run where people run them; PART="everyday --full" has the
# tests too.
BENCH_IN := $(if $(filter-out everyday --%,$(or $(PART),all)),$(BENCH_VENV),$(VENV))
bench: $(BENCH_IN)/.ready
	$(BENCH_IN)/bin/python benchmarks/bench.py $(PART)

# calib against other methods on the measured cases, in out/rivals; HALF=--set-aside for those that are looked at once.
rivals: $(BENCH_VENV)/.ready
	rm -rf out/rivals/made
	$(BENCH_VENV)/bin/python -m challenge.measured --out out/rivals/made --leave-out 4 --cases-only $(HALF)
	cd benchmarks && ../$(BENCH_VENV)/bin/python -m rivals.run --cases ../out/rivals/made/cases \
	  --answers ../out/rivals/made/answers --out ../out/rivals

lint: $(READY)
	$(BIN)/ruff check calib challenge tests benchmarks docs
	$(BIN)/ruff format --check calib challenge tests benchmarks docs
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/proselint check --config docs/proselint.json README.md CONTRIBUTING.md CODE_OF_CONDUCT.md SECURITY.md \
	  docs/*.md docs/formats docs/joss docs/gallery docs/reading docs/statistics docs/tutorials

format: $(READY)
	$(BIN)/ruff check --fix calib challenge tests benchmarks docs
	$(BIN)/ruff format calib challenge tests benchmarks docs

# $(call setup,extra,constraints): make the target's virtual environment with an optional extra. With another Python:
# make test VENV=.venv-3.13 PYTHON=python3.13
define setup
	@python=$$(for p in $(PYTHON) python3.12 python3.13 python3.14 python3 python; do \
	  $$p -c 'import sys; raise SystemExit(sys.version_info < (3, 12))' >/dev/null 2>&1 \
	    && echo $$p && break; done); \
	if [ -z "$$python" ]; then \
	  echo "calib needs Python 3.12 or newer; found $$({ command -v python3 >/dev/null && python3 --version; } 2>&1 || echo none). Install a newer Python and run make again." >&2; \
	  exit 1; \
	fi; \
	set -e; \
	$(@D)/bin/python -c 'import sys; raise SystemExit(sys.version_info < (3, 12))' >/dev/null 2>&1 \
	  || $$python -m venv --clear $(@D); \
	$(@D)/bin/python -m pip install --quiet --disable-pip-version-check $(2) -e '.[$(1)]'; \
	touch $@
endef

$(READY): pyproject.toml constraints.txt
	$(call setup,test,-c constraints.txt)

$(VENV)/.docs: pyproject.toml constraints.txt
	$(call setup,docs,-c constraints.txt)

$(BENCH_VENV)/.ready: pyproject.toml constraints.txt constraints-bench.txt
	$(call setup,bench,-c constraints.txt -c constraints-bench.txt)

# What is released, as strangers get it: the sdist, and the wheel made from it, installed into an empty environment and
# used from elsewhere.
RELEASE := $(CURDIR)/out/release
INSTALLED := whl
install-check: $(READY)
	rm -rf $(RELEASE) && mkdir -p $(RELEASE)/elsewhere
	$(BIN)/python -m venv $(RELEASE)/build && $(RELEASE)/build/bin/pip install -q build
	$(RELEASE)/build/bin/python -m build --outdir $(RELEASE)/dist .
	set -e; for made in $(INSTALLED); do \
	  $(BIN)/python -m venv $(RELEASE)/$$made; \
	  $(RELEASE)/$$made/bin/pip install -q -c constraints.txt $(RELEASE)/dist/*.$$made; \
	  (cd $(RELEASE)/elsewhere; PATH=$(RELEASE)/$$made/bin:$$PATH; calib --version; calib doctor --quick >/dev/null; \
	   calib template bekker --out $$made.csv; calib fit $$made.csv --model bekker --out $$made; \
	   python -c 'import calib; calib.load_he2019("rut_depth"); print(calib.__file__)'); \
	done

# The same of the sdist itself, and with the oldest dependencies that pyproject.toml allows, of which warnings are none of
# ours.
OLDEST_TESTS := tests/cli/test_machine.py tests/data tests/models/test_equations.py tests/inference/test_io.py \
  tests/validation/test_prediction.py tests/gap/test_case.py
release-check: INSTALLED := whl tar.gz
release-check: install-check
	$(BIN)/python -m venv $(RELEASE)/oldest
	$(RELEASE)/oldest/bin/pip install -q -c constraints-oldest.txt $(RELEASE)/dist/*.whl pytest hypothesis syrupy
	$(RELEASE)/oldest/bin/python -m pytest -q -o filterwarnings= -W ignore $(OLDEST_TESTS)

clean:
	rm -rf $(VENV) $(BENCH_VENV) .venv-crates out
