#!/bin/sh
# check_program.sh PROGRAM PACKAGE TESTS: check for a program that some tests use.
# If the program is missing, root installs it from apt; other users are told how to install it.
set -u

program=$1
package=$2
tests=$3

is_installed() {
    command -v "$program" >/dev/null || [ -x "/usr/sbin/$program" ]
}

is_installed && exit 0

if [ "$(id -u)" -eq 0 ] && command -v apt-get >/dev/null; then
    echo "Setting up: installing $package from apt, for $tests"
    log=$(mktemp)
    { apt-get update && DEBIAN_FRONTEND=noninteractive apt-get install -y "$package"; } \
        >"$log" 2>&1 || tail -n 5 "$log" >&2
    rm -f "$log"
    is_installed && exit 0
fi

echo "$program is not installed: $tests are skipped. To run them:"
echo "    sudo apt update && sudo apt install $package"
