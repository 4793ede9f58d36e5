#!/usr/bin/env bash
# debian.sh PACKAGES FILE: bring packages of Debian that tests need, unless FILE (a pattern) is there. Without it they are skipped.
set -euo pipefail
package=$1  # one or several, separated by spaces
compgen -G "$2" >/dev/null && exit 0
if ! command -v apt-get >/dev/null || [ "$(id -u)" -ne 0 ]; then
    echo "setup: no $package here and no right to install it: its tests will be skipped" >&2
    exit 0
fi
export DEBIAN_FRONTEND=noninteractive
echo "Installing $package for the tests"
apt-get update -qq </dev/null || echo "setup: apt-get update reported errors; going on with the lists it has" >&2
apt-get install -qq -y --no-install-recommends -o DPkg::Lock::Timeout=120 $package </dev/null >/dev/null ||
    echo "setup: apt-get could not install $package: its tests will be skipped" >&2
