#!/usr/bin/env bash
# postgres.sh: bring Debian's PostgreSQL, which the tests of a database on a server need. Without it they are skipped.
set -euo pipefail
ls /usr/lib/postgresql/*/bin/initdb >/dev/null 2>&1 && exit 0
if ! command -v apt-get >/dev/null || [ "$(id -u)" -ne 0 ]; then
    echo "setup: no PostgreSQL here and no right to install it: its tests will be skipped" >&2
    exit 0
fi
export DEBIAN_FRONTEND=noninteractive
echo "Installing PostgreSQL for the tests"
apt-get update -qq </dev/null || echo "setup: apt-get update reported errors; going on with the lists it has" >&2
apt-get install -qq -y --no-install-recommends -o DPkg::Lock::Timeout=120 postgresql </dev/null >/dev/null ||
    echo "setup: apt-get could not install postgresql: its tests will be skipped" >&2
