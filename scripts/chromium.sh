#!/usr/bin/env bash
# chromium.sh: bring Debian's Chromium, which the tests of `kerv board` open its pages in. Without it they are skipped.
set -euo pipefail
[ -x /usr/bin/chromium ] && exit 0
if ! command -v apt-get >/dev/null || [ "$(id -u)" -ne 0 ]; then
    echo "setup: no Chromium here and no right to install it: its tests will be skipped" >&2
    exit 0
fi
export DEBIAN_FRONTEND=noninteractive
echo "Installing Chromium for the tests"
apt-get update -qq </dev/null || echo "setup: apt-get update reported errors; going on with the lists it has" >&2
apt-get install -qq -y --no-install-recommends -o DPkg::Lock::Timeout=120 chromium </dev/null >/dev/null ||
    echo "setup: apt-get could not install chromium: its tests will be skipped" >&2
