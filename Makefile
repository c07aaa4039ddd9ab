# A handful of verbs. `make demo` and `make test` need nothing but Python 3.11, git and make.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
BENCH := $(VENV)/.bench
GROUND := $(VENV)/.ground
DOCS := $(VENV)/.docs
SOAK_MINUTES ?= 60

.PHONY: demo test test-fast test-long test-ground test-fleet test-postgres check docs bench bench-measured bench-paper-a bench-paper-b bench-loop bench-ablation bench-decoys bench-experiments bench-sufficiency bench-service bench-fleet serve clean

$(STAMP): pyproject.toml
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --upgrade pip
	$(BIN)/pip install --quiet torch==2.13.0
	$(BIN)/pip install --quiet --editable ".[dev,neural]"
	$(BIN)/python -m twin_core.compiled
	touch $@

$(BENCH): $(STAMP)
	$(BIN)/pip install --quiet --editable ".[bench,neural]"
	touch $@

$(GROUND): $(STAMP)
	$(BIN)/pip install --quiet --editable ".[dev,neural,ground]"
	! command -v npm >/dev/null || npm install --silent --prefix $(VENV)/openmct openmct@4
	! command -v npm >/dev/null || npm install --silent --prefix $(VENV)/grafana @grafana/schema typescript
	touch $@

$(DOCS): $(STAMP)
	$(BIN)/pip install --quiet --editable ".[docs]"
	touch $@

demo: $(STAMP)
	$(BIN)/twin demo --out demo-out

# File by file: what a file sets up is set up once, and the long ones do not come last. Three processes on two cores, for tests of
# the service wait; searches do not. Threads within small matrix products wait for each other longer than they compute.
# Python keeps its bytecode: the tests start hundreds of processes, each of which would compile the sources again.
PYTEST := PYTHONDONTWRITEBYTECODE= OMP_NUM_THREADS=1 $(BIN)/pytest --dist loadfile --no-loadscope-reorder

test: $(STAMP)
	$(PYTEST) -n 3 -m "not long and not ground and not fleet"

# The demonstration, the quick start and the operator's guide, as they are printed, and searches of more than twenty seconds.
test-long: $(STAMP)
	$(PYTEST) -n 2 -m long

test-fast: $(STAMP)
	$(PYTEST) -n 3 -m "not slow and not long and not e2e and not browser and not ground and not fleet"

# Several processes on PostgreSQL, and their faults.
test-fleet: $(STAMP)
	TWIN_TEST_STORE=postgres $(BIN)/pytest -m fleet tests/service/fleet

# On PostgreSQL every test of the service that starts no process of its own.
test-postgres: $(STAMP)
	TWIN_TEST_STORE=postgres $(PYTEST) -n 3 -m "not fleet and not long and not e2e and not browser and not ground" tests/service

check: $(STAMP)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

docs: $(DOCS)
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet

bench: $(STAMP)
	$(BIN)/python -m benchmarks

bench-measured: $(STAMP)
	$(BIN)/python -m benchmarks.measured_sets

bench-paper-a: $(BENCH)
	$(BIN)/python -m benchmarks.paper_a

bench-experiments: $(BENCH)
	$(BIN)/python -m benchmarks.next_experiment

bench-loop: $(BENCH)
	$(BIN)/python -m benchmarks.loop
	$(BIN)/python -m benchmarks.band_study
	$(BIN)/python -m benchmarks.loop_rivals

# Cases of two seeds, three of every group; the full suite takes a day on two cores.
bench-ablation: $(BENCH)
	for seed in 1000 5000; do $(BIN)/python -m benchmarks.cases --out ablation-cases --first-seed $$seed --limit 3 --networks 1; done
	$(BIN)/python -m benchmarks.ablation --cases ablation-cases
	$(BIN)/python -m benchmarks.lone_changes
	$(BIN)/python -m benchmarks.gradients
	$(BIN)/python -m benchmarks.likeliest

bench-decoys: $(BENCH)
	$(BIN)/python -m benchmarks.decoys

bench-sufficiency: $(STAMP)
	$(BIN)/python -m benchmarks.sufficiency

bench-service: $(STAMP)
	$(BIN)/python -m benchmarks.service
	$(BIN)/python -m benchmarks.service_life
	$(BIN)/python -m benchmarks.service_years
	$(BIN)/python -m benchmarks.soak --minutes $(SOAK_MINUTES)
	$(BIN)/python -m benchmarks.anomaly_events
	$(BIN)/python -m benchmarks.forecast_coverage

bench-fleet: $(STAMP)
	$(BIN)/python -m benchmarks.fleet
	$(BIN)/python -m benchmarks.fleet_store
	$(BIN)/python -m benchmarks.fleet_filter
	$(BIN)/python -m benchmarks.family
	$(BIN)/python -m benchmarks.sqlite_before
	$(BIN)/python -m benchmarks.fleet_page
	$(BIN)/python -m benchmarks.fleet_faults
	$(BIN)/python -m benchmarks.fleet_stream

bench-paper-b: $(BENCH)
	$(BIN)/python -m benchmarks.paper_b

# Beside the products of a control room themselves: Yamcs, Open MCT, Prometheus. What is not installed is skipped.
test-ground: $(GROUND)
	$(BIN)/pytest -m ground

serve: $(STAMP)
	$(BIN)/twin serve

clean:
	rm -rf $(VENV) demo-out .pytest_cache .mypy_cache .ruff_cache
