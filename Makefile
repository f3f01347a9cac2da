# Everything is done by make demo and make test; both set up what they need in .venv.
# The Python that .venv is made from:
PYTHON ?= python3

BIN := .venv/bin

.PHONY: setup demo test lint clean linuxcnc chromium

setup:
	@$(PYTHON) tools/setup_venv.py

demo: setup
	$(BIN)/rtest demo

lint: setup
	$(BIN)/ruff check .
	$(BIN)/lint-imports

# The graphs of the tests must not join that of a machine in the same network.
test: export ROS_AUTOMATIC_DISCOVERY_RANGE ?= LOCALHOST
test: setup lint linuxcnc chromium
	$(BIN)/python -m pytest -m "not graph and not alone" -n 2 --dist loadfile
	$(BIN)/python -m pytest -m "graph or alone"

# For the tests on a real controller, which are skipped without it.
linuxcnc:
	@tools/install_linuxcnc.sh

# For the tests of the page in a browser, which are skipped without it.
chromium:
	@tools/install_chromium.sh

clean:
	rm -rf .venv .pytest_cache .ruff_cache .import_linter_cache build install log
	find src test tools -name __pycache__ -prune -exec rm -rf {} + || true
	rm -rf src/*/*.egg-info src/*/build
