# Sets up, tests, demonstrates and packages Lightpage. A fresh machine needs Python 3.11, pip and make, nothing else.

VENV ?= .venv
BIN := $(VENV)/bin
PYTHON ?= $(shell command -v python3.11 || command -v python3)
STAMP := $(VENV)/.installed
# Two test processes, one arithmetic thread each: more threads than cores only make the tests wait for each other.
WORKERS ?= 2
PYTEST_ARGS ?=
IMAGE_TARGET ?= runtime
IMAGE_TAG ?= lightpage:$(IMAGE_TARGET)

# Tests and benches start many processes, and each would compile every module anew.
export PYTHONDONTWRITEBYTECODE =
# onnxruntime reports home unless told not to.
export ORT_DISABLE_TELEMETRY = 1
ONE_THREAD := OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1 NUMEXPR_NUM_THREADS=1

.PHONY: help setup demo demo-hardware test pytest test-busy test-long planted test-lowest messages notebooks bench bench-gpu bench-speed bench-service bench-other-servers bench-scaling dashboard soak bench-codec bench-hardware bench-image-search bench-decoders train-decoders results site image sbom check-image check-camera-image lock licences audit release-check proto lint format clean
.DELETE_ON_ERROR:

help:  ## list the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 16

setup: $(STAMP)  ## make the virtual environment with everything in it

# Where a C compiler and the headers of Python are, the page code is compiled; the last line says whether it was.
# Debian splits ensurepip off into a package of its own; there the machine's pip puts a pip into the environment.
SOURCES := pyproject.toml constraints.txt setup.py $(wildcard lightpage/codec/compiled/*.[ch])
define environment
@test -n "$(PYTHON)" || { echo "make: no python3 found; install Python 3.11 or newer" >&2; exit 1; }
@$(PYTHON) -c 'import sys; sys.exit("make: Python 3.11 or newer wanted, got " + sys.version if sys.version_info < (3, 11) else 0)'
@test -x $(BIN)/pip || $(PYTHON) -m venv $(VENV) 2>/dev/null || \
  { $(PYTHON) -m venv --clear --without-pip $(VENV) && $(PYTHON) -m pip --python $(BIN)/python install --quiet pip; }
endef

$(STAMP): $(SOURCES)
	@echo "installing everything into $(VENV): 2.5 GB, in some three minutes"
	$(environment)
	$(BIN)/pip install --quiet --constraint constraints.txt --editable '.[cpu,train,dev]'
	@$(BIN)/lightpage --version
	@touch $@

# What reads, calibrates and serves pages; of a machine that has everything it installs nothing.
READING := $(VENV)/.installed-reading
$(READING): $(SOURCES)
	@test ! -e $(STAMP) || $(MAKE) --no-print-directory $(STAMP)
	@test -e $(STAMP) || echo "installing what reads pages into $(VENV): 0.5 GB, in about a minute"
	$(environment)
	@test -e $(STAMP) || $(BIN)/pip install --quiet --constraint constraints.txt --editable '.[cpu]'
	@$(BIN)/lightpage --version
	@touch $@

demo: $(READING)  ## run the whole main job on a simulated device, into out/demo
	$(BIN)/lightpage demo --out out/demo

HARDWARE := out/demo-hardware
demo-hardware: $(STAMP)  ## the main job over fake cameras, real packets, a serial line: needs libaravis-0.8-0 and Linux
	$(BIN)/lightpage virtual-device --out $(HARDWARE)/device -- \
	    $(BIN)/lightpage demo --source camera:$(HARDWARE)/device/device.toml --out $(HARDWARE)

PYTEST := $(ONE_THREAD) $(BIN)/pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder
test: $(STAMP)  ## lint, and beside it every test but the long ones; prints the slowest, and how far all stayed below the budget
	@$(BIN)/python -m tests.budget "make test" $(MAKE) --no-print-directory -j2 lint pytest

pytest: $(STAMP)
	$(PYTEST) -m "not long" --durations 20 --durations-min 5 $(PYTEST_ARGS)

# Files whose tests wait for threads or processes.
WAITING = $(shell grep -lrE "eventually|Popen|subprocess" tests --include="test_*.py")
test-busy: $(STAMP)  ## beside four busy processes: every test but the long ones once, then ten times those that wait
	$(BIN)/python -m tests.busy 1 $(MAKE) --no-print-directory pytest
	$(BIN)/python -m tests.busy 10 env $(PYTEST) -q -m "not long" $(WAITING)

test-long: $(STAMP)  ## tests that take minutes and prove little more
	$(PYTEST) -m long $(PYTEST_ARGS)

PLANTED_ARGS ?=
planted: $(STAMP)  ## plant 60 faults, one at a time, and print which of them the tests find; PLANTED_ARGS="--out FOLDER" resumes
	$(ONE_THREAD) $(BIN)/python -m tests.planted.plant $(PLANTED_ARGS)

notebooks: $(STAMP)  ## run docs/notebooks anew, and keep what they print and draw
	$(BIN)/python -m tests.system.notebooks

build/full-size.zip: $(STAMP)
	$(BIN)/python -m analysis.comparison.kept_bundle --kept analysis/weights/paper/-0.6deg-32e-4px --out $@

messages: $(STAMP)  ## write anew what the command line says in the failures that people meet most: tests/messages
	$(PYTEST) tests/messages --snapshot-update

LOWEST := build/lowest
test-lowest: $(STAMP)  ## a share of the tests with the lowest versions that pyproject.toml allows of what the runtime needs
	$(BIN)/uv venv --quiet --clear --python $(BIN)/python $(LOWEST)
	$(BIN)/uv pip compile --quiet --python $(LOWEST) --resolution lowest-direct --extra cpu pyproject.toml -o $(LOWEST)/requirements.txt
	$(BIN)/uv pip install --quiet --python $(LOWEST) -r $(LOWEST)/requirements.txt pytest pytest-timeout onnx
	$(ONE_THREAD) $(LOWEST)/bin/python -m pytest -q -p no:cacheprovider tests/lightpage/recording tests/lightpage/test_files.py \
	    tests/lightpage/cli tests/lightpage/codec/test_erasure.py tests/runtime/model tests/runtime/client tests/runtime/commands/test_commands.py \
	    tests/runtime/commands/test_user_bytes.py tests/runtime/archives/run/test_storage.py tests/runtime/service/frames

lint: $(STAMP)  ## ruff, layers of imports, mypy --strict, rules of tests and words, hadolint
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports --no-cache --no-logo
	$(BIN)/mypy
	$(BIN)/mypy release/*.py
	$(BIN)/python -m tests.rules
	$(BIN)/hadolint Dockerfile

format: $(STAMP)  ## let ruff put the code in order
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# What was trained is kept and only measured, which takes hours on two cores, most of them for the full-size page. Two
# decoders of the device without defects are trained, in an hour.
COMPARE := $(BIN)/python -m analysis.comparison.decoders
PASSES := --method wave --method wave-refined --method coherent --method refined --method oracle --method oracle-refined
bench-decoders: $(STAMP)  ## decoders on the same data sets, against the oracles: the table of what is kept, resumed when run again
	$(COMPARE) --angle -0.6 --method ray --method mode --method fast $(PASSES) --out runs/bench-decoders/sheared
	$(COMPARE) --angle 0 --method mode $(PASSES) --out runs/bench-decoders/square
	$(COMPARE) --angle -0.6 --exposure 0.13 --steps 3000 --method coherent --method refined --method oracle \
	    --levels 4 --levels 8 --levels 16 --out runs/bench-decoders/dim
	$(COMPARE) --angle -0.6 --symbol-size 2 --pages 130 --steps 4000 --published-steps 1125 --method mode --method coherent \
	    --method refined --method oracle --out runs/bench-decoders/small-symbols
	$(COMPARE) --angle -0.6 --exposure 0.13 --symbol-size 2 --pages 130 --steps 3000 --method coherent --method refined \
	    --method oracle --out runs/bench-decoders/dim-small-symbols
	$(COMPARE) --profile paper --angle -0.6 --angle 0 --pages 20 --steps 4000 --method coherent --method refined --method oracle \
	    --out runs/bench-decoders/full-size
	$(COMPARE) --profile paper --angle -0.6 --symbol-size 2 --pages 12 --steps 4000 --method coherent --method refined \
	    --method oracle --out runs/bench-decoders/full-size-small-symbols
	$(COMPARE) --ideal --angle 0 --angle -0.6 --method mode --published-steps 1125 --out runs/bench-decoders/ideal
	$(BIN)/python -m analysis.speed.speed --decoder fast --decoder coherent --decoder wave --decoder refined \
	    --decoder "ray 32/64" --decoder "ray 64/128"
	$(BIN)/python -m analysis.speed.scaling

# Exposures of 1 and 0.13: bright light, and about the dimmest in which two known pages still calibrate the device.
train-decoders: $(STAMP)  ## every decoder on every data set at quarter scale, trained anew: days on two cores, resumed when run again
	$(COMPARE) --angle 0 --angle -0.6 --exposure 1 --exposure 0.13 \
	    --symbol-size 4 --symbol-size 2 --pages 500 --levels 4 --levels 8 --levels 16 --trained runs/train-decoders/kept --keep \
	    --out runs/train-decoders

# Of kept full-size decoders, on pages simulated there. It needs no bundle, and a machine with a GPU needs no environment of
# its own: `python3 -m analysis.gpu.bench --out FOLDER` with this folder and an ONNX Runtime for CUDA on its path.
GPU_ARGS ?=
# onnxruntime for GPUs and that for CPUs exclude each other, so this environment is another than that of `make setup`.
GPU_VENV ?= .venv-gpu
GPU_STAMP := $(GPU_VENV)/.installed
$(GPU_STAMP): pyproject.toml constraints.txt setup.py
	@command -v nvidia-smi >/dev/null || { echo "make: no nvidia-smi: bench-gpu needs an NVIDIA GPU and its driver" >&2; exit 1; }
	@test -x $(GPU_VENV)/bin/pip || $(PYTHON) -m venv $(GPU_VENV)
	$(GPU_VENV)/bin/pip install --quiet --constraint constraints.txt --editable '.[gpu,train]'
	@touch $@

bench-gpu: $(GPU_STAMP)  ## pages in batches on a GPU: every target with its verdict; in 8 minutes, resumed when run again
	$(GPU_VENV)/bin/python -m analysis.gpu.bench --out runs/bench-gpu $(GPU_ARGS)

SPEED_ARGS ?= --decoder fast --decoder coherent --decoder wave --decoder refined --decoder "ray 32/64"
bench-speed: $(STAMP)  ## time decoders side by side in one run: SPEED_ARGS chooses them
	$(BIN)/python -m analysis.speed.speed $(SPEED_ARGS)

BENCH_SERVICE := runs/bench-service
bench-service: $(STAMP)  ## the service under load, faults and attack, from outside: in about an hour
	@mkdir -p $(BENCH_SERVICE)
	$(BIN)/lightpage bench --json $(BENCH_SERVICE)/page.json
	$(BIN)/python -m analysis.service.overload --json $(BENCH_SERVICE)/overload.json
	$(BIN)/python -m analysis.service.lifecycle --json $(BENCH_SERVICE)/lifecycle.json
	$(BIN)/python -m analysis.service.changes --json $(BENCH_SERVICE)/changes.json
	$(BIN)/python -m analysis.attacks.hostile --json $(BENCH_SERVICE)/hostile.json
	$(BIN)/python -m analysis.attacks.outgoing --json $(BENCH_SERVICE)/outgoing.json
	$(BIN)/python -m analysis.service.inference_protocol --out $(BENCH_SERVICE)/inference-protocol --json $(BENCH_SERVICE)/inference-protocol.json
	$(BIN)/python -m analysis.attacks.kills --out $(BENCH_SERVICE)/kills --json $(BENCH_SERVICE)/kills.json
	$(BIN)/python -m analysis.attacks.identity --json $(BENCH_SERVICE)/identity.json
	$(BIN)/python -m analysis.service.transport --json $(BENCH_SERVICE)/transport.json
	$(BIN)/python -m analysis.attacks.memory_attacks --json $(BENCH_SERVICE)/memory.json
	$(BIN)/python -m analysis.hardware.recalibration --load 0.6 --json $(BENCH_SERVICE)/recalibration.json

dashboard: $(STAMP)  ## draw docs/images/dashboard.png from a service under load: needs prometheus
	$(BIN)/python -m analysis.dashboard.dashboard --out docs/images/dashboard.png

bench-other-servers: $(STAMP)  ## the service beside MLServer, KServe and Ray Serve with the same graph: installs them first, 1.5 GB
	@mkdir -p $(BENCH_SERVICE)
	$(BIN)/python -m analysis.service.other_servers --out $(BENCH_SERVICE)/other-servers --json $(BENCH_SERVICE)/other-servers.json

soak: $(STAMP)  ## 40 minutes at 80% of the service's load: does its memory grow?
	@mkdir -p $(BENCH_SERVICE)
	$(BIN)/python -m analysis.service.soak --json $(BENCH_SERVICE)/soak.json

BENCH_SCALING := runs/bench-scaling
QUICK := --kept analysis/weights/bench/-0.6deg-32e-4px --out $(BENCH_SCALING)/quick
bench-scaling: $(STAMP)  ## bulk runs whose workers and Ray nodes are killed, speed, memory, a second run, a fleet, how far it goes: in hours
	$(ONE_THREAD) $(BIN)/python -m analysis.scaling.faults $(QUICK) --json $(BENCH_SCALING)/local.json
	$(ONE_THREAD) $(BIN)/python -m analysis.scaling.faults --engine ray $(QUICK) --json $(BENCH_SCALING)/ray.json
	$(ONE_THREAD) $(BIN)/python -m analysis.scaling.second_run --out $(BENCH_SCALING) --json $(BENCH_SCALING)/second-run.json
	$(ONE_THREAD) $(BIN)/python -m analysis.scaling.cost --out $(BENCH_SCALING) --json $(BENCH_SCALING)/cost.json
	$(ONE_THREAD) $(BIN)/python -m analysis.scaling.fleet --deep 2 --out $(BENCH_SCALING)/fleet --json $(BENCH_SCALING)/fleet.json

bench: $(STAMP)  ## time one page: inference alone, whole decode, through gRPC
	$(BIN)/lightpage bench

bench-codec: $(STAMP)  ## user bytes on recorded pages, wrong bytes ever given out, time of the code: about three hours
	$(BIN)/python -m analysis.codec.ledger --out runs/bench-codec
	$(BIN)/python -m analysis.codec.refit --recording runs/bench-codec/32e/known.h5 --bundle runs/bench-codec/32e/kept.zip
	$(ONE_THREAD) $(BIN)/python -m analysis.codec.safety --json runs/bench-codec/safety.json
	$(ONE_THREAD) $(BIN)/python -m analysis.codec.speed --json runs/bench-codec/speed.json

BENCH_HARDWARE := runs/bench-hardware
bench-hardware: $(STAMP)  ## cameras, trigger, pairing over fake cameras in half an hour; then drifts and a week in hours, resumed when run again
	@mkdir -p $(BENCH_HARDWARE)
	$(ONE_THREAD) $(BIN)/python -m analysis.hardware.cameras --json $(BENCH_HARDWARE)/cameras.json
	$(ONE_THREAD) $(BIN)/python -m analysis.hardware.scpi --queries 10000 --json $(BENCH_HARDWARE)/scpi.json
	$(ONE_THREAD) $(BIN)/python -m analysis.hardware.pairs --shots 2000 --json $(BENCH_HARDWARE)/pairs.json
	$(ONE_THREAD) $(BIN)/python -m analysis.hardware.plugs --times 30 --json $(BENCH_HARDWARE)/plugs.json
	$(BIN)/python -m analysis.hardware.latency --pages 100 --json $(BENCH_HARDWARE)/latency.json
	$(BIN)/python -m analysis.hardware.drifts --out $(BENCH_HARDWARE)/drifts --json $(BENCH_HARDWARE)/drifts.json
	$(BIN)/python -m analysis.hardware.week --out $(BENCH_HARDWARE)/week --json $(BENCH_HARDWARE)/week.json
	$(BIN)/python -m analysis.hardware.week --pages 500 --stroke -0.02 --axial 0.2 --out $(BENCH_HARDWARE)/light --json $(BENCH_HARDWARE)/light.json

bench-image-search: $(STAMP)  ## how the image is found, followed and confirmed: tables and a picture, in more than an hour
	$(BIN)/python -m analysis.tracking.image_search --out runs/bench-image-search

RESULTS_ARGS ?=
results: $(STAMP)  ## write docs/results/index.md from analysis/results: RESULTS_ARGS="--from runs/bench-decoders" collects first
	$(BIN)/python -m analysis.results.page $(RESULTS_ARGS)

proto: $(STAMP)  ## regenerate the gRPC stubs from proto/
	$(BIN)/uv run --quiet --python $(BIN)/python proto/generate.py

site: $(STAMP)  ## build the site of docs/ and of the reference made of the code, into build/site; a broken link is an error
	$(ONE_THREAD) $(BIN)/python release/build_site.py

image:  ## build the container image (IMAGE_TARGET=runtime, camera, deep, gpu or ray; RELEASE=1 BASE=NAME@sha256:DIGEST; IMAGE_PLATFORM)
	LIGHTPAGE_RELEASE=$(RELEASE) LIGHTPAGE_BASE=$(BASE) LIGHTPAGE_PLATFORM=$(IMAGE_PLATFORM) \
	    release/build_image.sh $(IMAGE_TARGET) $(IMAGE_TAG)

# Needs root where buildah made the image, since it mounts it; so does check-image.
sbom: $(STAMP)  ## write build/sbom/lightpage-TARGET.cdx.json: all that is in the image, as CycloneDX
	LIGHTPAGE_PYTHON=$(BIN)/python release/write_sbom.sh $(IMAGE_TAG)

check-image:  ## start the image that buildah built, and see whether it keeps its promises
	release/check_image.sh $(IMAGE_TAG) $(BUNDLE)

check-camera-image: $(STAMP)  ## the same with image `camera`, which then does the main job over the simulated device
	LIGHTPAGE_CHECK_DEVICE=build/device $(BIN)/lightpage virtual-device --out build/device -- \
	    release/check_image.sh lightpage:camera

lock: $(STAMP)  ## write release/locks anew from pyproject.toml and constraints.txt: versions, and a SHA-256 of every file
	UV_FIND_LINKS="$${UV_FIND_LINKS:-$$PIP_FIND_LINKS}" $(BIN)/python release/lock.py

licences: $(STAMP)  ## list the licences of all that is in the image, by its SBOM; fails on one that is not allowed
	$(BIN)/python release/licences.py build/sbom/$(subst /,-,$(subst :,-,$(IMAGE_TAG))).cdx.json

audit: $(STAMP)  ## ask for known vulnerabilities of the locked packages; ends with 3 where nobody could tell of all
	$(BIN)/python release/audit.py

RELEASE_STEPS ?=
release-check: $(STAMP)  ## the checklist of a release: versions, wheels in empty environments, site, notebooks, image, planted faults
	$(BIN)/python release/check_release.py $(RELEASE_STEPS)

clean:  ## remove what was built and measured, and leave the environment
	rm -rf build out .pytest_cache .mypy_cache .ruff_cache
