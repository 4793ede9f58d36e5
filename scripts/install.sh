#!/usr/bin/env bash
# install.sh STAMP: make .venv and install kerv with its development tools into it: the files that requirements/ names.
# STAMP is written last, so that an interrupted installation is never taken for a finished one.
# PYTHON=/path/to/python chooses the interpreter; CUDA=1 or CUDA=0 the build of PyTorch, by default that for CUDA where an
# NVIDIA driver is, else the CPU's.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

stamp=$1
venv=.venv
cpu_index=${KERV_TORCH_INDEX:-https://download.pytorch.org/whl/cpu} # CPU builds of PyTorch are not on the package index

fail() {
    echo "setup: $1" >&2
    exit 1
}

suits() { "$1" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] < (3, 14))' >/dev/null 2>&1; }

choose_python() {
    local candidate found=
    for candidate in ${PYTHON:-python3.11 python3.12 python3.13 python3}; do
        suits "$candidate" || continue
        # Debian and Ubuntu ship Python without the two modules that a virtual environment needs
        if "$candidate" -c 'import ensurepip, venv' >/dev/null 2>&1; then
            echo "$candidate"
            return
        fi
        found=${found:-$candidate}
    done
    if [ -n "$found" ]; then
        fail "$found cannot make virtual environments; on Debian or Ubuntu: sudo apt-get install $("$found" -c 'import sys; print("python%d.%d-venv" % sys.version_info[:2])')"
    fi
    fail "kerv needs Python 3.11, 3.12 or 3.13 and found none${PYTHON:+ in PYTHON=$PYTHON}; install one, or name it: make setup PYTHON=/path/to/python3.11"
}

choose_build() {
    case "${CUDA:-}" in
        0) echo cpu ;;
        "") if [ "${OSTYPE#linux}" != "$OSTYPE" ] && [ ! -e "${KERV_NVIDIA:-/proc/driver/nvidia/version}" ]; then echo cpu; else echo cuda; fi ;;
        *) echo cuda ;;
    esac
}

rm -f "$stamp" "${stamp%-cuda}" "${stamp%-cuda}-cuda"
if ! { suits "$venv/bin/python" && "$venv/bin/python" -m pip --version >/dev/null 2>&1; }; then
    python=$(choose_python)
    "$python" -m venv --clear "$venv"
fi

build=$(choose_build)
if [ "$build" = cpu ]; then
    what="the CPU build of PyTorch, together about 0.6 GB to fetch (make setup CUDA=1 takes the build for NVIDIA GPUs, 3 GB)"
else
    what="the CUDA build of PyTorch, together about 3 GB to fetch (make setup CUDA=0 takes the CPU's, 0.6 GB)"
fi
echo "Installing kerv into $venv with $what"

pip() {
    local quiet=--quiet
    if [ -t 1 ]; then quiet=; fi
    # shellcheck disable=SC2086  # empty means no argument
    "$venv/bin/python" -m pip install $quiet --disable-pip-version-check "$@"
}
# By itself and without what it needs, so that the second index serves nothing else. All else must have a known hash.
if [ "$build" = cpu ]; then
    echo "PyTorch ..."
    torch=$(grep '^torch==' requirements/cpu.txt)
    if ! "$venv/bin/python" -m pip freeze --disable-pip-version-check 2>/dev/null | grep -qxF "$torch" &&
        ! pip --no-deps --retries 1 --extra-index-url "$cpu_index" "$torch" 2>/dev/null; then
        echo "setup: $torch is not to be had here: taking the PyTorch that the package index offers (up to 3 GB)" >&2
        build=cuda
    fi
fi
files=(--requirement requirements/common.txt)
if [ "$build" = cpu ]; then
    echo "The other packages, about a minute ..."
else
    files+=(--requirement requirements/cuda.txt)
    echo "PyTorch and the other packages ..."
fi
pip --no-deps --require-hashes "${files[@]}"
echo "kerv itself ..."
pip --no-deps --no-build-isolation --editable '.[dev]'
touch "$stamp"
echo "kerv is installed. $venv/bin/kerv doctor checks this machine, make demo shows what kerv does"
