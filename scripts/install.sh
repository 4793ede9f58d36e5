#!/usr/bin/env bash
# install.sh STAMP: make .venv and install kerv with its development tools into it. STAMP is written last, so that an
# interrupted installation is never taken for a finished one. PYTHON=/path/to/python chooses the interpreter.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

stamp=$1
venv=.venv

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

rm -f "$stamp"
if ! { suits "$venv/bin/python" && "$venv/bin/python" -m pip --version >/dev/null 2>&1; }; then
    python=$(choose_python)
    "$python" -m venv --clear "$venv"
fi

quiet=--quiet
if [ -t 1 ]; then quiet=; else echo "Installing kerv and its libraries into $venv (a minute or more)"; fi
# shellcheck disable=SC2086  # empty means no argument
"$venv/bin/python" -m pip install $quiet --disable-pip-version-check --editable '.[dev]'
touch "$stamp"
