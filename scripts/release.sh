#!/usr/bin/env bash
# release.sh PYTHON: build the sdist and the wheel into dist/. Each must run an episode in an empty environment, outside
# the checkout, and hold no path of this machine. Run again after a failure: dist/ is made anew.
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

[ -z "$(git status --porcelain)" ] || fail "commit or remove your changes first: git status"
rm -rf "$dist"
"$python" -m hatchling build -d "$dist" >/dev/null

"$python" -m venv "$scratch/venv"
grep -v '^-e ' requirements/cpu.txt >"$scratch/versions.txt"
for package in "$dist"/*.tar.gz "$dist"/*.whl; do
    mkdir -p "$scratch/files" "$scratch/work"
    case $package in
        *.whl) "$python" -m zipfile -e "$package" "$scratch/files" ;;
        *) tar -xzf "$package" -C "$scratch/files" ;;
    esac
    if private=$(grep -rlF -e "$PWD" -e "$HOME/" "$scratch/files"); then
        fail "$(basename "$package") names a folder of this machine, in: $(basename -a $private | tr '\n' ' ')"
    fi
    echo "$(basename "$package"): installing"
    "$scratch/venv/bin/python" -m pip install --quiet --disable-pip-version-check --constraint "$scratch/versions.txt" "$package"
    (cd "$scratch/work" && "$scratch/venv/bin/kerv" rollout method=one_pass task=drawer-open episodes=1 record=0)
    "$scratch/venv/bin/python" -m pip uninstall --quiet --yes kerv
    rm -rf "$scratch/files" "$scratch/work"
done
ls -l "$dist"
