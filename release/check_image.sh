#!/usr/bin/env bash
# Starts an image that buildah built, as it is meant to run, and sees whether it keeps its promises: not root, root file
# system read-only, no torch (unless deep), what its SBOM says and nothing else, healthy only while it serves, gone soon
# after SIGTERM. An image of another revision than the work tree's is refused.
#
#   release/check_image.sh [TAG [BUNDLE]]
#
# TAG: lightpage:runtime. BUNDLE: a file to serve from the volume /bundles, without a frame source, in place of what the
# image serves by itself. Needs root, since it makes a mount namespace of its own.
#
# Environment:
#   LIGHTPAGE_BUILDER        buildah, if anything
#   LIGHTPAGE_STORAGE        where buildah keeps images (default build/containers)
#   LIGHTPAGE_SBOM           the SBOM (default what write_sbom.sh wrote, build/sbom/TAG.cdx.json)
#   LIGHTPAGE_CHECK_DEVICE   folder of a running `lightpage virtual-device`, in whose network this is: the image then does
#                            the main job over its cameras, serial line and modulator
set -euo pipefail
hardware="${LIGHTPAGE_CHECK_DEVICE:+$(realpath "$LIGHTPAGE_CHECK_DEVICE")}"
[ -z "${2:-}" ] || [ "$1" = --inside ] || set -- "$1" "$(realpath "$2")"
cd "$(dirname "$0")/.."

tag="${1:-lightpage:runtime}"
bundle="${2:-}"
# a free one, unless told: another service may listen on any fixed port
port="${LIGHTPAGE_CHECK_PORT:-$(python3 -c 'import socket; s = socket.socket(); s.bind(("127.0.0.1", 0)); print(s.getsockname()[1])')}"
storage="$(realpath -m "${LIGHTPAGE_STORAGE:-build/containers}")"

if [ "${LIGHTPAGE_BUILDER:-buildah}" != buildah ]; then
  echo "check_image: LIGHTPAGE_BUILDER is '$LIGHTPAGE_BUILDER'; buildah wanted: no other image can be checked" >&2
  exit 2
fi
if [ "${1:-}" != --inside ]; then
  exec unshare --mount --pid --fork --kill-child --propagation private "$0" --inside "$tag" "$bundle"
fi

# ---- inside a mount and process namespace of its own: whatever is mounted or left running here ends with it ---------------
tag="$2"
bundle="$3"
scratch="$(mktemp -d)"
store=(buildah --storage-driver vfs --root "$storage" --runroot "$scratch/run")
clean_up() {
  [ -z "${service:-}" ] || kill -KILL "$service" 2>/dev/null || true
  umount --recursive "$scratch/root" 2>/dev/null || umount --recursive --lazy "$scratch/root" 2>/dev/null || true
  [ -z "${container:-}" ] || "${store[@]}" rm "$container" >/dev/null || true
  rm -rf --one-file-system "$scratch"
}
trap clean_up EXIT

field() {
  "${store[@]}" inspect --type image --format "$1" "$tag"
}
label() { field "{{index .Docker.Config.Labels \"org.opencontainers.image.$1\"}}"; }
wanted="$(release/revision.sh)"
if ! made="$(label revision 2>"$scratch/said")"; then
  echo "check_image: no image $tag in $storage ($(tail -1 "$scratch/said")); wanted what" \
    "make image LIGHTPAGE_BUILDER=buildah builds" >&2
  exit 2
fi
if [ "$made" != "$wanted" ]; then
  echo "check_image: image $tag in $storage is of revision '$made', wanted that of the work tree, '$wanted':" \
    "make image LIGHTPAGE_BUILDER=buildah builds it anew" >&2
  exit 2
fi
container="$("${store[@]}" from --pull-never "$tag")"
tree="$("${store[@]}" mount "$container")"

root="$scratch/root"
mkdir "$root"
mount --bind "$tree" "$root"
mount --types proc proc "$root/proc"
mount --types tmpfs -o mode=755 tmpfs "$root/dev"
for device in null zero random urandom; do
  touch "$root/dev/$device"
  mount --bind "/dev/$device" "$root/dev/$device"
done
mount --types tmpfs -o mode=1777 tmpfs "$root/tmp"
for volume in bundles state; do
  mount --types tmpfs -o uid=10001,gid=10001,mode=755 tmpfs "$root/$volume"
done
[ -z "$bundle" ] || install -m 644 "$bundle" "$root/bundles/$(basename "$bundle")"
if [ -n "$hardware" ]; then # what `--device`, `--group-add` and `--network host` lend to a container
  mkdir "$root/dev/pts" "$root/bundles/device"
  mount --bind /dev/pts "$root/dev/pts"
  mount --bind "$hardware" "$root/bundles/device"
  chmod 666 "$hardware/modulator.sock" "$(realpath "$hardware/pulse-generator")"
fi
mount -o remount,bind,ro "$root"

mapfile -t environment < <(field '{{range .Docker.Config.Env}}{{println .}}{{end}}' | sed '/^$/d')
mapfile -t entrypoint < <(field '{{range .Docker.Config.Entrypoint}}{{println .}}{{end}}' | sed '/^$/d')
mapfile -t arguments < <(field '{{range .Docker.Config.Cmd}}{{println .}}{{end}}' | sed '/^$/d')
mapfile -t health < <(field '{{range .Docker.Config.Healthcheck.Test}}{{println .}}{{end}}' | sed '/^$/d;1d')
user="$(field '{{.Docker.Config.User}}')"
sbom="${LIGHTPAGE_SBOM:-build/sbom/${tag//[:\/]/-}.cdx.json}"

become_image() { # in place of the calling shell, so that a signal reaches the command itself
  exec env --ignore-environment "${environment[@]}" chroot --userspec="$user" "$root" "$@"
}
in_image() { (become_image "$@"); }
failures=0
claim() { # claim WORDS COMMAND...: the command must succeed
  local words="$1"
  shift
  if "$@" >"$scratch/said" 2>&1; then
    echo "ok      $words"
  else
    echo "FAILED  $words"
    sed 's/^/        /' "$scratch/said" | tail -20
    failures=$((failures + 1))
  fi
}
not() { ! "$@"; }
import_torch() { in_image python -c 'import torch'; }
probe() { in_image env LIGHTPAGE_HEALTH_TARGET="127.0.0.1:$port" "${health[@]}"; }
probe_until_healthy() {
  for _ in $(seq 60); do
    if probe; then return 0; fi
    if ! kill -0 "$service" 2>/dev/null; then
      cat "$scratch/service.log"
      return 1
    fi
    sleep 1
  done
  cat "$scratch/service.log"
  return 1
}

claim "runs as 10001:10001" test "$user $(in_image id -u):$(in_image id -g)" = "10001:10001 10001:10001"
claim "cannot write to its root" not in_image sh -c "touch /opt/lightpage/written || touch /etc/written || touch /written || touch /usr/bin/written"
claim "can write to its state and bundles" in_image touch /state/written /bundles/written
case "$tag" in
  *deep*) claim "has torch" import_torch ;;
  *) claim "has no torch" not import_torch ;;
esac
claim "keeps onnxruntime's telemetry off" test "$(in_image printenv ORT_DISABLE_TELEMETRY)" = 1
claim "has no trace of the builder's packages" test -z "$(ls -A "$root/run/packages" "$root/run/secrets" 2>/dev/null)"
claim "names its version, revision and time" test -n "$(label version)" -a -n "$(label revision)" -a -n "$(label created)"
lock="release/locks/$(label title | sed 's/^lightpage //').txt"
claim "holds what $sbom and $lock say, and nothing else" python3 release/inventory.py "$tree" --against "$sbom" "$lock"
claim "has no pip" not in_image python -c 'import pip'
claim "has the command" in_image "${entrypoint[0]}" --help
has_compiled_code() { in_image "${entrypoint[0]}" --version | grep "page code: compiled"; }
claim "computes the page code compiled" has_compiled_code
claim "is not healthy before it serves" not probe

# What the image itself starts, on loopback and a port of the check's own.
[ -z "$bundle" ] || arguments=(--bundle "/bundles/$(basename "$bundle")" --address 0.0.0.0:50051)
for index in "${!arguments[@]}"; do
  [ "${arguments[index]}" != "0.0.0.0:50051" ] || arguments[index]="127.0.0.1:$port"
done
become_image "${entrypoint[@]}" "${arguments[@]}" >"$scratch/service.log" 2>&1 &
service=$!
claim "is healthy once it serves" probe_until_healthy
kill -TERM "$service" 2>/dev/null || true
gone() {
  for _ in $(seq 30); do
    kill -0 "$service" 2>/dev/null || return 0
    sleep 1
  done
  return 1
}
claim "is gone within 30 s of SIGTERM" gone
claim "ended in order" wait "$service"
claim "is not healthy afterwards" not probe

if [ -n "$hardware" ]; then
  main_job() { in_image lightpage demo --source camera:/bundles/device/device.toml --out /state/demo; }
  claim "does the main job over cameras, a serial line and a modulator" main_job
fi

[ "$failures" = 0 ] || { echo "check_image: $failures of the claims about $tag failed" >&2; exit 1; }
echo "check_image: $tag keeps its promises"
