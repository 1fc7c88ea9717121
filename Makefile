# make demo    a small search on DeepMind Control's Cheetah-Run, and a training with what it found
# make models  three small trained agents in runs/, some minutes each: aarl evaluate, aarl video
# make test    all tests, what they need included
# make check   lint, types, and the tests that are not slow
# make lint    ruff and mypy
# make wheel   builds the wheel, installs it without extras and trains with it
# make docs    the documentation, docs/_build/html/index.html

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
# Headless rendering for the tests from pixels; the browser for the test of optuna-dashboard; the database.
RENDERING := libegl1 libosmesa6 libgl1-mesa-dri
BROWSER := chromium chromium-driver
DATABASE := postgresql
DEMO := dmc,search

.PHONY: demo models test check lint docs wheel system clean

demo: $(VENV)/.installed
	$(BIN)/aarl search zoo_configs/search/demo.yml --workers 2
	$(BIN)/aarl cross-validate zoo_configs/search/demo.yml --workers 2
	$(BIN)/aarl train cheetah-run --steps 20000 --aux-loss runs/demo/winner.yml --folder runs/demo/winner
	$(BIN)/aarl report runs/demo

models: $(VENV)/.installed
	$(BIN)/aarl train cartpole-balance --steps 20000 --folder runs/cartpole
	$(BIN)/aarl train reacher-easy --steps 20000 --folder runs/reacher
	$(BIN)/aarl train ball_in_cup-catch --steps 20000 --folder runs/catch

test: $(VENV)/.installed-dev system
	$(BIN)/python -m pytest -n 2 --dist worksteal

check: lint system
	$(BIN)/python -m pytest -n 2 --dist worksteal -m "not slow"

lint: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	mkdir -p build/types/sb3_aarl
	ln -sfn $(CURDIR)/sb3_aarl/* $(CURDIR)/search $(CURDIR)/zoo_configs build/types/sb3_aarl/
	cd build/types && $(abspath $(BIN))/mypy --config-file $(CURDIR)/pyproject.toml -p sb3_aarl
	$(BIN)/mypy benchmarks results

docs: $(VENV)/.installed-docs
	$(BIN)/python -m sphinx -q -W -b html docs docs/_build/html

# labmaze, which dm-control asks for, has no wheel for Python 3.13; the suite does not need it.
define install
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	if $(BIN)/python -c 'import sys; sys.exit(sys.version_info < (3, 13))'; then \
		$(BIN)/python -m pip install --quiet --no-deps -c constraints.txt dm-control; \
	fi
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[$(1)]'
	touch $@
endef

$(VENV)/.installed: setup.cfg constraints.txt
	$(call install,$(DEMO))

$(VENV)/.installed-docs: setup.cfg constraints.txt
	$(call install,docs)

$(VENV)/.installed-dev: setup.cfg constraints.txt
	$(call install,dev)
	touch $(VENV)/.installed

# Installs what is missing if that is possible without asking; else one line says what to do.
system:
	@missing=; for package in $(RENDERING) $(BROWSER) $(DATABASE); do \
		dpkg -s $$package >/dev/null 2>&1 || missing="$$missing $$package"; \
	done; \
	if [ -n "$$missing" ]; then \
		if [ "$$(id -u)" = 0 ]; then sudo=; else sudo='sudo -n'; fi; \
		if ! { $$sudo apt-get update -qq && $$sudo apt-get install -y -qq --no-install-recommends $$missing; } >/dev/null 2>&1; \
		then echo "Some tests need system packages that could not be installed; as root: apt-get install$$missing"; fi; \
	fi

# As a user has it: the wheel without extras and constraints in an empty environment, README's first examples in an empty
# folder. Only PyTorch is the version that was tested: that is small where pip finds a build of it for the CPU.
wheel:
	set -e; folder=$$(mktemp -d); trap 'rm -rf $$folder' EXIT; \
	$(PYTHON) -m venv $$folder/venv; \
	export OMP_NUM_THREADS=1 PATH=$$folder/venv/bin:$$PATH; \
	pip wheel --quiet --no-deps --wheel-dir $$folder .; \
	pip install --quiet --no-compile $$(grep ^torch== constraints.txt) $$folder/*.whl; \
	cd $$folder; echo 'raise SystemExit("not the package")' > search.py; \
	python -c 'from sb3_aarl import SACAux; SACAux("MlpPolicy", "Pendulum-v1", aux_loss="aarl-state").learn(150)'; \
	aarl losses; \
	aarl train Pendulum-v1 --steps 400 --evaluations 1 --episodes 1

clean:
	rm -rf $(VENV) build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache
