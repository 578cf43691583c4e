#!/bin/sh
# check_broker.sh: is there the MQTT broker that some tests talk to?
# As root it is installed from apt; otherwise its absence is told, and those tests are skipped.
set -u

command -v mosquitto >/dev/null || [ -x /usr/sbin/mosquitto ] && exit 0

if [ "$(id -u)" -eq 0 ] && command -v apt-get >/dev/null; then
    echo 'Setting up: installing mosquitto from apt, for the tests of MQTT'
    log=$(mktemp)
    { apt-get update && DEBIAN_FRONTEND=noninteractive apt-get install -y mosquitto; } \
        >"$log" 2>&1 || tail -n 5 "$log" >&2
    rm -f "$log"
    command -v mosquitto >/dev/null || [ -x /usr/sbin/mosquitto ] && exit 0
fi

echo 'There is no mosquitto: the tests of MQTT are skipped. To run them, too:'
echo '    sudo apt update && sudo apt install mosquitto'
