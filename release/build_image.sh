#!/usr/bin/env bash
# Builds a target of the Dockerfile with whatever this machine has: a Docker engine, or buildah without any daemon.
#
#   release/build_image.sh [TARGET] [TAG]        TARGET: runtime (default), camera, deep, gpu or ray; TAG: lightpage:TARGET
#
# Environment:
#   LIGHTPAGE_BUILDER   docker or buildah; unset, the first that answers
#   LIGHTPAGE_STORAGE   where buildah keeps images (default build/containers)
#   LIGHTPAGE_BASE      the image that it is made from (default debian:bookworm-slim), NAME@sha256:DIGEST for a release
#   LIGHTPAGE_RELEASE   1 for a release: it needs a base with a digest, and a work tree without changes
#   LIGHTPAGE_PLATFORM  linux/amd64 or linux/arm64 (default: this machine's)
#   SOURCE_DATE_EPOCH   the time that the image says it was made at (default: that of the commit)
#
# Where buildah has no debian:bookworm-slim, mmdebstrap makes one from the machine's own apt sources. The machine's own
# pip settings, certificates and package folders are lent to the build as secrets and as a build context; none of them stays in the image.
set -euo pipefail
cd "$(dirname "$0")/.."

target="${1:-runtime}"
tag="${2:-lightpage:$target}"
case "$target" in
  runtime | camera | deep | gpu | ray) ;;
  *) echo "build_image: target '$target' is none of runtime, camera, deep, gpu, ray" >&2; exit 2 ;;
esac

# ---- what is to be built, before anything is -------------------------------------------------------------------------
named_base=debian:bookworm-slim
base="${LIGHTPAGE_BASE:-$named_base}"
digest=""
if [[ "$base" == *@* ]]; then
  digest="${base##*@}"
  if ! [[ "$digest" =~ ^sha256:[0-9a-f]{64}$ ]]; then
    echo "build_image: base '$base' has the digest '$digest'; sha256: and 64 hexadecimal digits wanted" >&2
    exit 2
  fi
fi
revision="$(release/revision.sh)"
case "${LIGHTPAGE_RELEASE:-}" in
  "" | 0) ;;
  1)
    if [ -z "$digest" ]; then
      echo "build_image: a release needs a base with a digest; got '$base', wanted BASE=$named_base@sha256:DIGEST" >&2
      exit 2
    fi
    if [[ "$revision" == *-changed || "$revision" = unknown ]]; then
      echo "build_image: a release is built from a commit; the work tree has changes, or is none of git's" >&2
      exit 2
    fi
    ;;
  *) echo "build_image: LIGHTPAGE_RELEASE is '$LIGHTPAGE_RELEASE'; 1 or nothing wanted" >&2; exit 2 ;;
esac

case "$(uname -m)" in
  x86_64) own_platform=linux/amd64 ;;
  aarch64) own_platform=linux/arm64 ;;
  *) own_platform="linux/$(uname -m)" ;;
esac
platform="${LIGHTPAGE_PLATFORM:-$own_platform}"
case "$platform" in
  linux/amd64) ;;
  linux/arm64)
    case "$target" in
      camera) echo "build_image: no image 'camera' for $platform: genicam has no wheel for it" >&2; exit 2 ;;
      deep) echo "build_image: no image 'deep' for $platform: the lock holds PyTorch's CPU build for x86_64 alone" >&2; exit 2 ;;
    esac
    ;;
  *) echo "build_image: platform '$platform' is none of linux/amd64, linux/arm64" >&2; exit 2 ;;
esac

SOURCE_DATE_EPOCH="${SOURCE_DATE_EPOCH:-$(git log -1 --format=%ct 2>/dev/null || date +%s)}"
export SOURCE_DATE_EPOCH
labels=(
  --label "org.opencontainers.image.title=lightpage $target"
  --label "org.opencontainers.image.version=$(sed -n 's/^version = "\(.*\)"$/\1/p' pyproject.toml)"
  --label "org.opencontainers.image.revision=$revision"
  --label "org.opencontainers.image.created=$(date --utc --date "@$SOURCE_DATE_EPOCH" +%Y-%m-%dT%H:%M:%SZ)"
  --label "org.opencontainers.image.licenses=MIT"
  --label "org.opencontainers.image.base.name=${base%@*}"
)
[ -z "$digest" ] || labels+=(--label "org.opencontainers.image.base.digest=$digest")
build_arguments=(--build-arg "BASE=$base" --build-arg "SOURCE_DATE_EPOCH=$SOURCE_DATE_EPOCH")

scratch="$(mktemp -d)"
trap 'rm -rf "$scratch"' EXIT

# ---- what the machine's pip is told, for the pip inside the build ----------------------------------------------------
# Writes $scratch/pip.conf, copies the certificates it names to $scratch/ca_bundle, and prints the local folders it names.
lend_pip_settings() {
  local pip_python=python3
  [ ! -x .venv/bin/python ] || pip_python=.venv/bin/python
  "$pip_python" -m pip config list 2>/dev/null | "$pip_python" release/lend_pip_settings.py "$scratch"
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
  if [ "$(in_buildah inspect --type image --format '{{.OCIv1.Architecture}}' "$base" 2>/dev/null)" = "${platform#linux/}" ]; then
    return
  fi
  if in_buildah pull --quiet --platform "$platform" "$base" >/dev/null 2>"$scratch/pulled"; then
    return
  fi
  if [ "$base" != "$named_base" ]; then
    echo "build_image: no registry gives $base, and nothing else can stand for it: $(tail -1 "$scratch/pulled")" >&2
    exit 1
  fi
  if ! command -v mmdebstrap >/dev/null; then
    echo "build_image: no registry gives $base and there is no mmdebstrap to make it; apt-get install mmdebstrap" >&2
    exit 1
  fi
  echo "build_image: making $base with mmdebstrap"
  mmdebstrap --quiet --variant=minbase --architectures="${platform#linux/}" \
    --dpkgopt='path-exclude=/usr/share/doc/*' --dpkgopt='path-include=/usr/share/doc/*/copyright' \
    --dpkgopt='path-exclude=/usr/share/man/*' --dpkgopt='path-exclude=/usr/share/locale/*' \
    --customize-hook='rm -f "$1/etc/resolv.conf" "$1/etc/hostname"' \
    bookworm "$scratch/base.tar"
  local container
  container="$(in_buildah from scratch)"
  in_buildah add --quiet "$container" "$scratch/base.tar" / >/dev/null
  in_buildah config --cmd bash --arch "${platform#linux/}" "$container"
  in_buildah commit --quiet --rm "$container" "docker.io/library/$base" >/dev/null
}

builder="$(choose_builder)"
mapfile -t folders < <(lend_pip_settings)
secrets=(--secret "id=pip_conf,src=$scratch/pip.conf")
[ ! -s "$scratch/ca_bundle" ] || secrets+=(--secret "id=ca_bundle,src=$scratch/ca_bundle")

# Foreign programs run where the kernel hands them to an emulator; a Docker engine says so by itself.
if [ "$builder" = buildah ] && [ "$platform" != "$own_platform" ]; then
  emulator="/proc/sys/fs/binfmt_misc/qemu-$([ "$platform" = linux/arm64 ] && echo aarch64 || echo x86_64)"
  if ! grep -q '^enabled' "$emulator" 2>/dev/null; then
    echo "build_image: this machine is $own_platform and has no emulator for $platform ($emulator);" \
      "build there, or: apt-get install qemu-user-static binfmt-support" >&2
    exit 1
  fi
fi

echo "build_image: building $tag for $platform with $builder"
case "$builder" in
  docker)
    [ "${#folders[@]}" -eq 0 ] || echo "build_image: docker cannot see the package folders ${folders[*]}; doing without" >&2
    DOCKER_BUILDKIT=1 docker build --platform "$platform" --target "$target" --tag "$tag" \
      "${labels[@]}" "${build_arguments[@]}" "${secrets[@]}" .
    ;;
  buildah)
    storage="$(realpath -m "${LIGHTPAGE_STORAGE:-build/containers}")"
    mkdir -p "$storage"
    provide_base
    lend_packages
    # The Docker format, since the OCI one has no place for a health check.
    in_buildah bud --isolation chroot --format docker --pull-never --platform "$platform" --target "$target" --tag "$tag" \
      --timestamp "$SOURCE_DATE_EPOCH" "${labels[@]}" "${build_arguments[@]}" "${secrets[@]}" --build-context "packages=$scratch/packages" .
    in_buildah images "$tag"
    ;;
  *)
    echo "build_image: LIGHTPAGE_BUILDER is '$builder'; docker or buildah wanted" >&2
    exit 2
    ;;
esac
