#!/usr/bin/env bash
# Builds a target of the Dockerfile with whatever this machine has: a Docker engine, or buildah without any daemon.
#
#   packaging/build_image.sh [TARGET] [TAG]        TARGET: runtime (default), camera, deep or gpu; TAG: lightpage:TARGET
#
# Environment:
#   LIGHTPAGE_BUILDER   docker or buildah; unset, the first that answers
#   LIGHTPAGE_STORAGE   where buildah keeps images (default build/containers)
#
# Where buildah has no debian:bookworm-slim, mmdebstrap makes one from the machine's own apt sources. The machine's own
# pip settings, certificates and package folders are lent to the build as secrets and as a build context; none of them stays in the image.
set -euo pipefail
cd "$(dirname "$0")/.."

target="${1:-runtime}"
tag="${2:-lightpage:$target}"
case "$target" in
  runtime | camera | deep | gpu) ;;
  *) echo "build_image: target '$target' is none of runtime, camera, deep, gpu" >&2; exit 2 ;;
esac

base=debian:bookworm-slim
scratch="$(mktemp -d)"
trap 'rm -rf "$scratch"' EXIT

# ---- what the machine's pip is told, for the pip inside the build ----------------------------------------------------
# Writes $scratch/pip.conf, copies the certificates it names to $scratch/ca_bundle, and prints the local folders it names.
lend_pip_settings() {
  local pip_python=python3
  [ ! -x .venv/bin/python ] || pip_python=.venv/bin/python
  "$pip_python" -m pip config list 2>/dev/null | "$pip_python" packaging/lend_pip_settings.py "$scratch"
}

# The folders as one tree, numbered: hard links where the file system allows, since they may be large.
lend_packages() {
  mkdir "$scratch/packages"
  local number=0
  for folder in "${folders[@]}"; do
    cp -al "$folder" "$scratch/packages/$number" 2>/dev/null || cp -aT "$folder" "$scratch/packages/$number"
    number=$((number + 1))
  done
}

choose_builder() {
  if [ -n "${LIGHTPAGE_BUILDER:-}" ]; then
    echo "$LIGHTPAGE_BUILDER"
  elif command -v docker >/dev/null && docker info >/dev/null 2>&1; then
    echo docker
  elif command -v buildah >/dev/null; then
    echo buildah
  else
    echo "build_image: no Docker engine answers and there is no buildah; start one, or: apt-get install buildah mmdebstrap" >&2
    exit 1
  fi
}

in_buildah() {
  buildah --storage-driver vfs --root "$storage" --runroot "$scratch/run" "$@"
}

# A slim Debian as the registry has it, made on the spot: no documentation, no manuals, no translations, no trace of its maker.
provide_base() {
  if in_buildah inspect --type image "$base" >/dev/null 2>&1; then
    return
  fi
  if in_buildah pull --quiet "$base" >/dev/null 2>&1; then
    return
  fi
  if ! command -v mmdebstrap >/dev/null; then
    echo "build_image: no registry gives $base and there is no mmdebstrap to make it; apt-get install mmdebstrap" >&2
    exit 1
  fi
  echo "build_image: making $base with mmdebstrap"
  mmdebstrap --quiet --variant=minbase \
    --dpkgopt='path-exclude=/usr/share/doc/*' --dpkgopt='path-include=/usr/share/doc/*/copyright' \
    --dpkgopt='path-exclude=/usr/share/man/*' --dpkgopt='path-exclude=/usr/share/locale/*' \
    --customize-hook='rm -f "$1/etc/resolv.conf" "$1/etc/hostname"' \
    bookworm "$scratch/base.tar"
  local container
  container="$(in_buildah from scratch)"
  in_buildah add --quiet "$container" "$scratch/base.tar" / >/dev/null
  in_buildah config --cmd bash "$container"
  in_buildah commit --quiet --rm "$container" "docker.io/library/$base" >/dev/null
}

builder="$(choose_builder)"
mapfile -t folders < <(lend_pip_settings)
secrets=(--secret "id=pip_conf,src=$scratch/pip.conf")
[ ! -s "$scratch/ca_bundle" ] || secrets+=(--secret "id=ca_bundle,src=$scratch/ca_bundle")

echo "build_image: building $tag with $builder"
case "$builder" in
  docker)
    [ "${#folders[@]}" -eq 0 ] || echo "build_image: docker cannot see the package folders ${folders[*]}; doing without" >&2
    DOCKER_BUILDKIT=1 docker build --target "$target" --tag "$tag" "${secrets[@]}" .
    ;;
  buildah)
    storage="$(realpath -m "${LIGHTPAGE_STORAGE:-build/containers}")"
    mkdir -p "$storage"
    provide_base
    lend_packages
    # The Docker format, since the OCI one has no place for a health check.
    in_buildah bud --isolation chroot --format docker --pull-never --target "$target" --tag "$tag" \
      "${secrets[@]}" --build-context "packages=$scratch/packages" .
    in_buildah images "$tag"
    ;;
  *)
    echo "build_image: LIGHTPAGE_BUILDER is '$builder'; docker or buildah wanted" >&2
    exit 2
    ;;
esac
