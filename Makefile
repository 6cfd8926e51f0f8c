# Everything a newcomer needs, in a virtual environment of its own (.venv). `make` alone lists the targets.
#
#   make demo                       film a pour, reconstruct it, score it
#   make test PYTHON=python3.12     with another interpreter (only read when .venv is made)

PYTHON ?= python3
BIN := .venv/bin
PYTEST := $(BIN)/python -m pytest -q --durations=15

# A PYTHON that somebody chose is taken at its word; the default gives way to any supported one that is there.
CANDIDATES := $(if $(filter file,$(origin PYTHON)),python3 python3.13 python3.12 python3.11 python3.10,$(PYTHON))
SUPPORTED := import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 13))

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help demo quick-test test test-all lint docs pictures leaderboard wheel kernel sanitize clean

# The compiled kernels, and what builds them: where one of these changes, they are built and installed anew.
KERNEL_FOLDERS := splashbench/native splashbench/*/kernel methods/*/kernel
KERNEL := setup.py build_kernel.py build_compilers.py $(wildcard $(foreach folder,$(KERNEL_FOLDERS),$(folder)/*.cpp $(folder)/*.h))

help:
	@echo "make demo        film a synthetic pour, reconstruct it and score it, into demo_output/"
	@echo "make quick-test  run some tests of every part, in under two minutes: after each edit"
	@echo "make test        run the tests, the slow ones left out: before each commit"
	@echo "make test-all    run every test (those without a CUDA device to run on skip)"
	@echo "make lint        check style, types, and which part imports which"
	@echo "make docs        build the documentation site into site/; open site/index.html"
	@echo "make pictures    draw the pictures of README.md and of the site anew, but for charts; fits methods first, which takes long"
	@echo "make leaderboard  make the page of the project's own results anew, and say which figures changed"
	@echo "make wheel       build the wheel into dist/"
	@echo "make kernel      build the compiled kernels in place, after an edit"
	@echo "make sanitize    run the kernels' tests under AddressSanitizer and UndefinedBehaviorSanitizer (needs g++)"
	@echo "make clean       remove everything the targets above made, .venv included"

demo: .venv/installed-synth
	@echo "==> Running the demo"
	$(BIN)/splashbench demo demo_output

# A file's tests stay together: they share scenes that take long to make. A worker may take 1 GB; slow tests take more.
test: .venv/installed-test
	@echo "==> Running the tests"
	$(PYTEST) -m "not slow and not cuda" -n auto --maxprocesses=4 --dist=loadfile

# Something of every folder of tests/, chosen by how long it takes; tests/test_quick.py holds it against the folders.
QUICK := $(addprefix tests/test_, alignment.py architecture.py files.py manifest.py markdown.py public_names.py quick.py) \
  $(addprefix tests/, benchmark/test_estimate.py cli/test_arguments.py cli/test_help.py cluster/test_cluster_place.py container/test_container_released.py \
  docs/test_commands.py docs/test_links.py docs/test_python_blocks.py download/test_fetch.py export/test_export_surface.py fuzz/test_fuzz_round_trips.py gaussians/test_ssim.py \
  harness/test_output_checks.py harness/test_runner_geometry.py harness/test_training_copy.py methods/test_renamed_settings.py \
  methods/test_scaffold_parts.py native/test_native_library.py observe/test_observe_fields.py prepare/test_gates.py \
  prepare/test_session.py render/test_render_parts.py replay/test_camera_paths.py report/test_report_leaderboard.py \
  restyle/test_filmed_dye.py scene/test_camera.py \
  score/test_score_neighbours.py score/test_score_notation.py score/test_score_protocol.py \
  selfcalibration/test_exposure.py study/test_study_table.py \
  submission/test_submission.py synth/test_synth_audio.py video/test_video_parts.py \
  viewer/test_viewer_clock.py viewer/test_viewer_splats.py)
quick-test: .venv/installed-test
	@echo "==> Running the quick tests"
	$(BIN)/python -m pytest -q -m "not slow and not cuda" -n auto --maxprocesses=2 --dist=loadfile $(QUICK)

test-all: .venv/installed-test
	@echo "==> Running every test"
	$(PYTEST)

lint: .venv/installed-dev
	@echo "==> Checking style and types"
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -m pytest -q tests/test_architecture.py

# Strict: a broken link or reference ends the build. mkdocs-material's notice about its successor is left out.
docs: .venv/installed-docs
	@echo "==> Building the documentation site"
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet
	@echo "open site/index.html"

pictures: .venv/installed-synth
	@echo "==> Drawing the pictures; scenes and fits go into build/pictures"
	$(BIN)/python docs/tools/pictures.py

leaderboard: .venv/ready
	@echo "==> Making the page of the project's own results"
	$(BIN)/splashbench leaderboard leaderboards/told_nothing/results leaderboards/told_nothing

wheel: .venv/ready
	@echo "==> Building the wheel"
	$(BIN)/python -m pip wheel --no-deps -w dist .

kernel: .venv/ready
	$(BIN)/python build_kernel.py

# Python itself is not built with the sanitizers, so their libraries are loaded before it; and before the C++ library,
# whose exceptions they watch. What Python leaves unfreed at its end is no leak of ours.
SANITIZE_CXX ?= g++
SANITIZE_VARIANT ?= avx2
sanitize: .venv/installed-test
	SPLASHBENCH_CXX=$(SANITIZE_CXX) $(BIN)/python build_kernel.py --sanitize --variant $(SANITIZE_VARIANT) --output build/sanitized
	@echo "==> Running the kernels' tests under the sanitizers"
	LD_PRELOAD="$$(for name in asan ubsan stdc++; do $(SANITIZE_CXX) -print-file-name=lib$$name.so; done | tr '\n' ' ')" \
	ASAN_OPTIONS=detect_leaks=0 UBSAN_OPTIONS=print_stacktrace=1 \
	SPLASHBENCH_KERNEL="$(CURDIR)/build/sanitized" SPLASHBENCH_SIMD=$(SANITIZE_VARIANT) \
	$(BIN)/python -m pytest -q -m "not slow and not cuda" tests/native tests/render tests/observe/test_carving.py tests/gaussians/test_ssim.py tests/methods/test_scaffold_kernel.py tests/methods/splashsplat/test_kernel_*.py

clean:
	rm -rf .venv build dist site demo_output example_output *.egg-info .pytest_cache .mypy_cache .ruff_cache splashbench/*/kernel/lib*.so methods/*/kernel/lib*.so
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# One call of pip for each set of optional packages, repeated only when what it would install may have changed.
.venv/installed-%: .venv/ready pyproject.toml constraints.txt $(KERNEL)
	@echo "==> Installing splashbench[$*] and what it needs (minutes the first time: PyTorch is large)"
	$(BIN)/python -m pip install --disable-pip-version-check -c constraints.txt -e ".[$*]"
	@touch $@

# A working .venv that somebody made by hand is kept.
.venv/ready:
	@if $(BIN)/python -c '$(SUPPORTED)' 2>/dev/null && $(BIN)/python -m pip --version >/dev/null 2>&1; then \
	  echo "==> Using the .venv that is there"; exit 0; \
	fi; \
	for candidate in $(CANDIDATES); do \
	  if "$$candidate" -c '$(SUPPORTED)' 2>/dev/null; then python=$$candidate; break; fi; \
	done; \
	if [ -z "$$python" ]; then \
	  echo "error: splashbench needs Python 3.10 to 3.13, and none of these is one: $(CANDIDATES); name one with PYTHON=..." >&2; \
	  exit 1; \
	fi; \
	if ! "$$python" -c 'import ensurepip, venv' 2>/dev/null; then \
	  echo "error: $$python cannot make a virtual environment; install its venv package (python3-venv on Debian and Ubuntu)" >&2; \
	  exit 1; \
	fi; \
	echo "==> Making .venv with $$python ($$("$$python" -c 'import platform; print(platform.python_version())'))"; \
	"$$python" -m venv --clear .venv
	@touch $@
