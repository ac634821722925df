#!/usr/bin/env bash
# Prints which revision the work tree is of, as the label of an image says it: the commit, with `-changed` where there are
# changes; `unknown` where git knows of none.
set -euo pipefail
cd "$(dirname "$0")/.."

revision="$(git rev-parse HEAD 2>/dev/null || echo unknown)"
[ "$revision" = unknown ] || [ -z "$(git status --porcelain)" ] || revision="$revision-changed"
echo "$revision"
