#!/usr/bin/env bash
# Grasps for a cloud, with curl and jq; the body is the .npy file as it is.
#
#   examples/curl.sh [URL [CLOUD.npy]]
set -euo pipefail
export LC_ALL=C # numbers with a point

url=${1:-http://127.0.0.1:8000}
cloud=${2:-$(dirname "${BASH_SOURCE[0]}")/clutter.npy}

answer=$(mktemp)
trap 'rm -f "$answer"' EXIT
# --globoff leaves [] in the URL alone; --retry waits as Retry-After says, after 429 and 503.
status=$(curl --silent --show-error --globoff --max-time 60 --retry 3 \
    --output "$answer" --write-out '%{http_code}' \
    --header 'Content-Type: application/x-npy' --data-binary "@$cloud" \
    "$url/grasps?viewpoint=[0.38,0.55,0.48]&up=[0,0,1]&support_height=0.05&max_grasps=5")

if [[ $status != 200 ]]; then
    echo "$status: $(jq --raw-output .detail "$answer")" >&2
    exit 1
fi
numbers=$(jq '.grasps[] | .score, .position[], .width' "$answer")
if [[ -z $numbers ]]; then
    echo "no grasps: $(jq --raw-output .reason "$answer")"
else
    # shellcheck disable=SC2086 # one argument a number; printf takes five for a line
    printf '%.2f  TCP at %.3f %.3f %.3f  opening %.3f m\n' $numbers
fi
