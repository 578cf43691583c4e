#!/usr/bin/env bash
# "CRC-16" without a further name is another checksum in crccheck 1.3.1 than in crcmod 1.7.
#
# Expected: two libraries agree on what "CRC-16" is; the catalogue of CRC algorithms gives this alias
# to CRC-16/ARC (check value 0xBB3D for the digits 1 to 9).
# Seen: crcmod 'crc-16' is 0xBB3D (ARC), crccheck Crc16 is 0x31C3 (XMODEM). Frames of one side are
# rejected by the other, all of them. "CCITT" is KERMIT (0x2189) in crccheck and libscrc, and 0x29B1
# is only found under the name "CCITT-FALSE".
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check crccheck==1.3.1 crcmod==1.7 libscrc==1.8.1
"$folder/venv/bin/python" - "$folder" <<'END'
from importlib.metadata import version

import crccheck.crc
import crcmod.predefined
import libscrc

print(', '.join(f'{name} {version(name)}' for name in ('crccheck', 'crcmod', 'libscrc')))
digits = b'123456789'
found = {
    "crcmod 'crc-16'": crcmod.predefined.mkPredefinedCrcFun('crc-16')(digits),
    'crccheck Crc16': crccheck.crc.Crc16.calc(digits),
    'crccheck CrcCcitt': crccheck.crc.CrcCcitt.calc(digits), 'libscrc ccitt': libscrc.ccitt(digits),
    "crcmod 'crc-ccitt-false'": crcmod.predefined.mkPredefinedCrcFun('crc-ccitt-false')(digits)}
for name, value in found.items():
    print(f'{name}: 0x{value:04X}')
assert list(found.values()) == [0xBB3D, 0x31C3, 0x2189, 0x2189, 0x29B1]
END
