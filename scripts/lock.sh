#!/usr/bin/env bash
# lock.sh PYTHON: write requirements/cpu.txt and cuda.txt, the versions that `make setup` installs, from what PYTHON's
# environment holds. Both are the same but for PyTorch's build.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
python=$1

mkdir -p requirements
frozen=$("$python" -m pip freeze --exclude-editable --disable-pip-version-check | grep -E '^[A-Za-z0-9_.-]+==' | grep -vE '^(kerv|torch)==')
torch=$("$python" -c 'from importlib.metadata import version; print(version("torch").partition("+")[0])')
for build in cpu cuda; do
    local=
    [ "$build" = cuda ] || local=+cpu
    {
        echo "# Versions that make setup installs ($build build of PyTorch). Written by make lock; pyproject.toml says what is needed."
        printf '%s\n' "$frozen" "torch==$torch$local" | sort -f
    } >"requirements/$build.txt"
done
