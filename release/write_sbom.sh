#!/usr/bin/env bash
# Writes the SBOM of an image that was built: build/sbom/TAG.cdx.json, with `:` of the tag as `-`.
#
#   release/write_sbom.sh [TAG]        TAG: lightpage:runtime
#
# Environment: LIGHTPAGE_BUILDER and LIGHTPAGE_STORAGE as for build_image.sh; LIGHTPAGE_PYTHON, which has the tools
# (default .venv/bin/python). With buildah it needs root, since it mounts the image.
set -euo pipefail
cd "$(dirname "$0")/.."

tag="${1:-lightpage:runtime}"
python="${LIGHTPAGE_PYTHON:-.venv/bin/python}"
out="build/sbom/${tag//[:\/]/-}.cdx.json"
storage="$(realpath -m "${LIGHTPAGE_STORAGE:-build/containers}")"
scratch="$(mktemp -d)"
store=(buildah --storage-driver vfs --root "$storage" --runroot "$scratch/run")
builder="${LIGHTPAGE_BUILDER:-}"
if [ -z "$builder" ]; then
  builder=buildah
  if command -v docker >/dev/null && docker info >/dev/null 2>&1; then builder=docker; fi
fi
clean_up() {
  if [ -n "${container:-}" ]; then
    case "$builder" in
      docker) docker rm "$container" >/dev/null || true ;;
      buildah) "${store[@]}" rm "$container" >/dev/null || true ;;
    esac
  fi
  rm -rf --one-file-system "$scratch"
}
trap clean_up EXIT

format='{{range $name, $value := .Config.Labels}}{{println (printf "%s=%s" $name $value)}}{{end}}'
case "$builder" in
  docker)
    container="$(docker create "$tag")"
    mkdir "$scratch/root"
    docker export "$container" | tar -x -C "$scratch/root" --exclude='dev/*'
    root="$scratch/root"
    labels="$(docker inspect --format "$format" "$tag")"
    ;;
  buildah)
    container="$("${store[@]}" from --pull-never "$tag")"
    root="$("${store[@]}" mount "$container")"
    labels="$("${store[@]}" inspect --type image --format "${format/.Config/.Docker.Config}" "$tag")"
    ;;
  *) echo "write_sbom: LIGHTPAGE_BUILDER is '$builder'; docker or buildah wanted" >&2; exit 2 ;;
esac
arguments=()
while IFS= read -r label; do
  [[ "$label" != org.opencontainers.image.* ]] || arguments+=(--label "$label")
done <<<"$labels"
"$python" release/sbom.py "$root" --out "$out" "${arguments[@]}"
