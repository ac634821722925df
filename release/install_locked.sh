#!/usr/bin/env bash
# Inside an image build: puts what a lock names, and our own wheel, into the environment of the image. Nothing else gets in.
#
#   release/install_locked.sh LOCK ENVIRONMENT
#
# pip refuses whatever has no SHA-256 in the lock, or another one. What it fetched is then installed without any index.
# ENVIRONMENT/wheels.sha256 names every installed wheel with its SHA-256.
set -euo pipefail
lock="$1"
environment="$2"
wheels="$(mktemp -d)"

# xcffib has no wheel: its archive is checked as well, and the locked tools in this pip's environment make one.
/opt/build/bin/pip wheel --quiet --no-cache-dir --require-hashes --only-binary :all: --no-binary xcffib --no-deps \
  --no-build-isolation --wheel-dir "$wheels" --requirement "$lock"
cp /dist/*.whl "$wheels"
/opt/build/bin/pip --python "$environment/bin/python" install --quiet --no-cache-dir --no-index --no-deps "$wheels"/*.whl
/opt/build/bin/pip --python "$environment/bin/python" check
(cd "$wheels" && sha256sum -- *.whl) >"$environment/wheels.sha256"
rm -r "$wheels"
