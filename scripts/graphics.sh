#!/usr/bin/env bash
# graphics.sh PYTHON: bring the OpenGL libraries that MuJoCo draws with, or say how. Does nothing where it can draw already.
set -euo pipefail
scripts=$(dirname "${BASH_SOURCE[0]}")
python=$1

fail() {
    echo "setup: $1" >&2
    exit 1
}

can_draw() { "$python" -I -S "$scripts/check_gl.py" >/dev/null 2>&1; }

packages() {
    # EGL is enough; OSMesa is the second way. Mesa dropped it in 25.1, so it is named only where apt has it.
    local second=
    if apt-cache show libosmesa6 >/dev/null 2>&1; then second=" libosmesa6"; fi
    echo "libegl1 libgl1 libgl1-mesa-dri$second"
}

can_draw && exit 0

if ! command -v apt-get >/dev/null; then
    fail "MuJoCo cannot draw: install EGL or OSMesa with Mesa's drivers (Fedora: sudo dnf install mesa-libEGL mesa-dri-drivers libglvnd-opengl), then make setup"
fi

if [ "$(id -u)" -eq 0 ]; then
    as_root=
elif sudo -n apt-get --version >/dev/null 2>&1; then
    as_root="sudo -n"
else
    fail "MuJoCo cannot draw without OpenGL libraries; type this, then make setup: sudo apt-get update && sudo apt-get install -y $(packages)"
fi

export DEBIAN_FRONTEND=noninteractive
echo "Installing the OpenGL libraries that MuJoCo draws with"
# One broken package source must not stop the rest: whether the libraries are there is what the installation finds out.
$as_root apt-get update -qq </dev/null || echo "setup: apt-get update reported errors; going on with the lists it has" >&2
names=$(packages)
# shellcheck disable=SC2086  # a list of words
$as_root apt-get install -qq -y --no-install-recommends -o DPkg::Lock::Timeout=120 $names </dev/null >/dev/null ||
    fail "apt-get could not install $names; its errors are above"
can_draw || fail "$names are installed and OpenGL still gives no context; see '$python -I $scripts/check_gl.py'"
