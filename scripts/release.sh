#!/usr/bin/env bash
# release.sh PYTHON: build the sdist and the wheel into dist/ and check both. The unpacked source sets itself up in an
# empty environment and runs an episode; then the wheel does so in the same environment. Neither may hold a path of this machine.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
python=$1
dist=$PWD/dist
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT

fail() {
    echo "release: $1" >&2
    exit 1
}

check_paths() {
    local found
    if found=$(grep -rlF -e "$PWD/" -e "$HOME/" "$1"); then fail "a folder of this machine is named in: $found"; fi
}

run_episode() {
    mkdir "$scratch/$1"
    (cd "$scratch/$1" && "$source/.venv/bin/kerv" rollout method=one_pass task=drawer-open episodes=1 record=0)
}

[ -z "$(git status --porcelain)" ] || fail "commit or stash your changes first: git status"
rm -rf "$dist"
"$python" -m hatchling build -d "$dist" >/dev/null

tar -xzf "$dist"/kerv-*.tar.gz -C "$scratch"
source=$(echo "$scratch"/kerv-*)
check_paths "$source"
"$python" -m zipfile -e "$dist"/kerv-*.whl "$scratch/wheel"
check_paths "$scratch/wheel"

PYTHON=$python make --no-print-directory -C "$source" setup
run_episode from-source
"$source/.venv/bin/python" -m pip install --quiet --no-deps --force-reinstall "$dist"/kerv-*.whl
run_episode from-wheel
ls -l "$dist"
