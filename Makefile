# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
#
# Needs python3 with venv, a C++ compiler and the Python package index; everything else comes from there.

PYTHON ?= python3
VENV ?= .venv
BUILD ?= build
SANITIZE_BUILD ?= build-sanitize
# Two at a time, or fewer where there are fewer processors: compiling Eigen takes about a gigabyte a job.
JOBS ?= $(shell $(PYTHON) -c "import os; print(min(2, os.cpu_count() or 1))")

BIN := $(VENV)/bin
TOOLS := $(VENV)/.tools-installed
DOCS_TOOLS := $(VENV)/.docs-tools-installed
PACKAGE_TOOLS := $(VENV)/.package-tools-installed
# What `make wheel` and `make sdist` give to pytest, for example "-k wrapper".
PYTEST_ARGUMENTS ?=
# Where `make test` leaves its results, as JUnit XML.
CXX_REPORT ?= $(abspath $(BUILD))/cxx-tests.xml
PYTHON_REPORT ?= $(abspath $(BUILD))/python-tests.xml
comma := ,
CXX_FILES = $(shell find openmmapi method platforms serialization tests examples -name '*.h' -o -name '*.cpp' 2>/dev/null)

.PHONY: all demo test check-format cxx-test sanitize sanitize-threads scaling python-test claims docs proof pictures wheel sdist conda check-workflow install format clean

all: test

# Install the package and compare it with fixed steps; tables on the screen, figures in out/.
demo: install
	$(BIN)/python -m openmmvrattle compare --output out

# One after the other, the fast ones first.
test:
	$(MAKE) check-format
	$(MAKE) cxx-test
	$(MAKE) python-test docs

check-format: $(TOOLS)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/clang-format --dry-run --Werror $(CXX_FILES)

# configure FOLDER OPTIONS: CMake for the C++ tests and benchmarks.
configure = $(BIN)/cmake -S . -B $(1) -G Ninja -DPython_EXECUTABLE="$(abspath $(BIN)/python)" \
	-DCMAKE_MAKE_PROGRAM="$(abspath $(BIN)/ninja)" -DOPENMMVRATTLE_BUILD_PYTHON=OFF $(2)

cxx-test: $(TOOLS)
	$(call configure,$(BUILD))
	$(BIN)/cmake --build $(BUILD) --parallel $(JOBS)
	$(BIN)/ctest --test-dir $(BUILD) --parallel $(JOBS) --output-on-failure --no-tests=error --output-junit "$(CXX_REPORT)"

# The C++ tests with AddressSanitizer (with its search for leaks) and UndefinedBehaviorSanitizer, GCC or Clang. OpenMM's own
# libraries are not instrumented: only memory that our code reads, writes or forgets is watched. Leak reports need frame
# pointers to tell whose memory it was. What compiles kernels for CUDA is a script in Python.
sanitize: $(TOOLS)
	$(call configure,$(SANITIZE_BUILD),-DCMAKE_BUILD_TYPE=RelWithDebInfo \
		-DCMAKE_CXX_FLAGS="-O1 -fsanitize=address$(comma)undefined -fno-sanitize-recover=all -fno-omit-frame-pointer")
	$(BIN)/cmake --build $(SANITIZE_BUILD) --parallel $(JOBS)
	ASAN_OPTIONS=detect_leaks=1:strict_string_checks=1:detect_stack_use_after_return=1 UBSAN_OPTIONS=print_stacktrace=1 \
		LSAN_OPTIONS=suppressions=$(abspath tests/leaks_of_others.txt):print_suppressions=0 \
		$(BIN)/ctest --test-dir $(SANITIZE_BUILD) --parallel $(JOBS) --exclude-regex CompileKernels \
		--output-on-failure --no-tests=error

# The C++ tests that share work among threads, with ThreadSanitizer; about three minutes.
sanitize-threads: $(TOOLS)
	$(call configure,$(SANITIZE_BUILD)-threads,-DCMAKE_BUILD_TYPE=RelWithDebInfo \
		-DCMAKE_CXX_FLAGS="-O1 -fsanitize=thread -fno-omit-frame-pointer")
	$(BIN)/cmake --build $(SANITIZE_BUILD)-threads --parallel $(JOBS) --target TestDynamicsThreads
	TSAN_OPTIONS=halt_on_error=1 \
		$(BIN)/ctest --test-dir $(SANITIZE_BUILD)-threads -R Threads --output-on-failure --no-tests=error

# How the cost of the constraint solver grows with the number of constraints; about five minutes, a minute and a half of it for
# OpenMM to create a Context with 200,000 bonds.
scaling: install $(TOOLS)
	$(call configure,$(BUILD),-DOPENMMVRATTLE_BUILD_BENCHMARKS=ON)
	$(BIN)/cmake --build $(BUILD) --parallel $(JOBS)
	$(BIN)/python benchmarks/scaling.py --program $(BUILD)/benchmarks/VRattleSolverBenchmark --context 200000

# The tests of one file one after the other, in one process; several files at a time.
python-test: install $(TOOLS)
	$(BIN)/python -m pytest python/tests --numprocesses $(JOBS) --dist loadfile --junitxml="$(PYTHON_REPORT)"

# The numbers that README and documentation claim, measured: gains, drift, the paper's figures. Minutes on an idle machine.
claims: install $(TOOLS)
	$(BIN)/python -m pytest python/tests -m claims

# The documentation as HTML in docs/_build/html; warnings are errors.
docs: install $(DOCS_TOOLS)
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs docs/_build/html
	@echo "The documentation is in docs/_build/html/index.html."

# A protein in water at constant energy beside VerletIntegrator: the table and figure of docs/proof.md, 100 ps in about an hour.
# PROOF_ARGUMENTS="--platform CUDA", for example, has a place of its own on the page.
PROOF_ARGUMENTS ?= --threads 1
proof: install
	$(BIN)/python benchmarks/proof.py --page $(PROOF_ARGUMENTS)

# The picture of the double pendulum in the README, drawn anew.
pictures: install
	$(BIN)/python docs/draw_pictures.py

# test_package FILE FOLDER: install FILE into an environment of its own, and run the tests of FOLDER from outside of it.
define test_package
	@set -e; environment=$$(mktemp -d); trap 'rm -rf "$$environment"' EXIT; set -x; \
	$(PYTHON) -m venv "$$environment/venv"; \
	"$$environment/venv/bin/python" -m pip install --quiet "$$(echo $(1))[test]"; \
	cd "$$environment"; \
	venv/bin/python -c "import openmmvrattle as o; print(o.__file__); assert o.__file__.startswith('$$environment')"; \
	venv/bin/python -m pytest -p no:cacheprovider "$(2)/python/tests" $(PYTEST_ARGUMENTS)
endef

# A wheel in dist for PYTHON, whatever the Python of .venv is, without OpenMM's libraries: they are those of the package
# openmm beside it. auditwheel names it by the oldest C library that it runs with.
wheel: TAG = $(shell $(PYTHON) -c "import sys; print('cp%d%d' % sys.version_info[:2])")
wheel: $(PACKAGE_TOOLS)
	rm -rf dist/*-$(TAG)-*.whl $(BUILD)/wheel-$(TAG)
	$(PYTHON) -m venv $(BUILD)/wheel-$(TAG)/venv
	CMAKE_BUILD_PARALLEL_LEVEL=$(JOBS) $(BUILD)/wheel-$(TAG)/venv/bin/python -m pip wheel --quiet --no-deps \
		--wheel-dir $(BUILD)/wheel-$(TAG) .
	PATH="$(abspath $(BIN)):$$PATH" $(BIN)/auditwheel repair --exclude libOpenMM.so --exclude libOpenMMOpenCL.so \
		--exclude libOpenMMCUDA.so --exclude libOpenMMHIP.so --wheel-dir dist $(BUILD)/wheel-$(TAG)/*.whl
	$(call test_package,$(CURDIR)/dist/*-$(TAG)-*.whl,$(CURDIR))

# All sources in dist, from which a build is made and tested with the tests that are in the archive.
sdist: $(PACKAGE_TOOLS)
	rm -rf dist/*.tar.gz $(BUILD)/sdist
	$(BIN)/python -m build --sdist --outdir dist .
	mkdir -p $(BUILD)/sdist
	tar -xzf dist/*.tar.gz -C $(BUILD)/sdist --strip-components 1
	git ls-files | (cd $(BUILD)/sdist && xargs -r ls -d) > /dev/null # it is complete
	$(call test_package,$(CURDIR)/$(BUILD)/sdist,$(CURDIR)/$(BUILD)/sdist)

# Is the hosted workflow well-formed? With the actionlint that is here, or else with Go, which fetches it.
ACTIONLINT ?= $(shell command -v actionlint || echo "go run github.com/rhysd/actionlint/cmd/actionlint@v1.7.12")
check-workflow:
	$(ACTIONLINT) .github/workflows/*.yml

# The recipe for conda as it would be built.
conda: $(PACKAGE_TOOLS)
	$(BIN)/python conda/render.py

# Always run: pip knows better than make what has changed. The build itself happens in an environment of its own.
install: $(BIN)/python
	CMAKE_BUILD_PARALLEL_LEVEL=$(JOBS) $(BIN)/python -m pip install ".[compare]"

format: $(TOOLS)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .
	$(BIN)/clang-format -i $(CXX_FILES)

clean:
	rm -rf $(BUILD) $(SANITIZE_BUILD) $(SANITIZE_BUILD)-threads docs/_build dist out $(VENV)

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)
	# Dependency groups need pip 25.1.
	$(BIN)/python -m pip install "pip>=25.1"

$(TOOLS): pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --group dev
	-$(BIN)/python -m pip download --quiet --no-deps --dest $(VENV)/gpu-wheels \
		$(foreach package,cuda-12 cuda-13 hip-6 hip-7,"openmm-$(package)==8.6.*") # for test_gpu_libraries.py
	touch $@

$(DOCS_TOOLS): pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --group docs
	touch $@

$(PACKAGE_TOOLS): pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --group package
	touch $@
