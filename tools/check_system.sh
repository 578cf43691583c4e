#!/bin/sh
# check_system.sh PYTHON: check for the system packages that pip cannot install.
# As root, the missing packages are installed; otherwise they are listed.
set -u

python=$1
apt_packages='g++ python3-venv python3-dev make'

fail() {
    printf '%s\n' "$@" >&2
    exit 1
}

apt_line() {
    echo "    sudo apt update && sudo apt install $apt_packages"
}

# Print the missing packages, one per line.
missing() {
    command -v g++ >/dev/null || echo 'g++'
    "$python" -c 'import ensurepip, venv' 2>/dev/null || echo 'python3-venv'
    "$python" -c '
import os, sys, sysconfig
sys.exit(not os.path.exists(os.path.join(sysconfig.get_path("include"), "Python.h")))
' 2>/dev/null || echo 'python3-dev'
}

# The ROS wheels of PyPI are built for x86_64 Linux with glibc only.
if [ "$(uname -s)" != Linux ] || [ "$(uname -m)" != x86_64 ]; then
    fail "This is $(uname -s) on $(uname -m); the ROS packages on PyPI exist for Linux on x86_64 only." \
         'Install ROS 2 Jazzy from apt and build with colcon: see docs/guides/deploy.md.'
fi

if command -v "$python" >/dev/null; then
    # The pins of constraints.txt have wheels for 3.11 to 3.14.
    "$python" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 14))' ||
        fail "$python is $("$python" --version 2>&1); Python 3.11 to 3.14 is required." \
             'Select another interpreter: make setup PYTHON=python3.12'
elif [ "$python" != python3 ]; then
    fail "$python is not installed."
fi

missing_packages=$(echo $(missing))
[ -n "$missing_packages" ] || exit 0

if [ "$(id -u)" -ne 0 ] || ! command -v apt-get >/dev/null; then
    fail "Missing packages: $missing_packages" 'On Debian or Ubuntu, install them and try again:' \
         "$(apt_line)"
fi

echo "Setting up: installing missing packages from apt: $missing_packages"
log=$(mktemp)
# shellcheck disable=SC2086 # a list of words
if ! { apt-get update && DEBIAN_FRONTEND=noninteractive apt-get install -y $apt_packages; } \
        >"$log" 2>&1; then
    tail -n 20 "$log" >&2
    rm -f "$log"
    fail 'apt-get failed. The command was:' "$(apt_line)"
fi
rm -f "$log"

missing_packages=$(echo $(missing))
[ -z "$missing_packages" ] ||
    fail "Still missing for $python: $missing_packages" \
         'This may not be the Python from apt. Try: make setup PYTHON=/usr/bin/python3'
