#!/bin/sh
# Installs Chromium with apt for the tests of the page, where root and apt are at hand; else they
# are skipped, and this says why.
set -eu
skipped() {
    echo "chromium: $1; tests of the page in a browser are skipped"
    exit 0
}
install() {
    DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends \
        -o Acquire::Retries=0 -o Acquire::http::Timeout=20 chromium >"$log" 2>&1
}
command -v chromium >/dev/null && exit 0
command -v apt-get >/dev/null || skipped 'not installed, and no apt-get to install it'
[ "$(id -u)" -eq 0 ] || skipped 'not installed; root does it: apt-get install chromium'
log=$(mktemp)
trap 'rm -f "$log"' EXIT
echo 'chromium: installing chromium with apt ...'
# The lists of packages are fetched only where those that are there do not know it.
install || {
    apt-get update -qq -o Acquire::Retries=0 -o Acquire::http::Timeout=20 >"$log" 2>&1 && install
} || skipped "apt-get failed ($(tail -n 1 "$log"))"
