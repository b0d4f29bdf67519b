"""An independent Modbus client at the simulated bender: reads by address what `benderd push` delivered.

Knows only the wire contract (protocols/reference-modbus.md), no code of benderd's.
Usage: modbus_peer.py PORT TABLE.csv PROGRAM REVISION
"""

import csv
import struct
import sys
import time
import zlib

from pymodbus.client import ModbusTcpClient

UNIT = 1
BENDS_MAX = 40


def read(client, address, count):
    """Registers as bytes, high byte first."""
    out = b""
    while count:
        now = min(count, 125)
        answer = client.read_holding_registers(address, count=now, device_id=UNIT)
        if answer.isError():
            sys.exit(f"reading {now} registers from {address}: {answer}")
        out += struct.pack(f">{now}H", *answer.registers)
        address, count = address + now, count - now
    return out


def check(what, found, expected):
    if found != expected:
        sys.exit(f"FAILED {what}: found {found!r}, expected {expected!r}")
    print(f"ok  {what}: {found!r}")


def text(raw):
    return raw.rstrip(b"\0").decode("ascii")


def active(client):
    """Revision, CRC, and the payload by its own bend count."""
    revision, crc = struct.unpack(">II", read(client, 24, 4))
    (bends,) = struct.unpack(">H", read(client, 2016, 1))
    return revision, crc, read(client, 2000, 20 + 6 * min(bends, BENDS_MAX))


def main():
    port, table, program, revision = int(sys.argv[1]), sys.argv[2], sys.argv[3], int(sys.argv[4])
    client = ModbusTcpClient("127.0.0.1", port=port)
    if not client.connect():
        sys.exit(f"nobody listens on port {port}")
    with open(table, newline="", encoding="utf-8") as file:
        *rows, tail = list(csv.DictReader(file))

    check("identification", struct.unpack(">I", read(client, 0, 2))[0], 0x42454E44)
    beat = read(client, 3, 1)
    deadline = time.monotonic() + 5
    while read(client, 3, 1) == beat:
        if time.monotonic() > deadline:
            sys.exit("FAILED heartbeat: stands still")
    print("ok  heartbeat: counts")

    found_revision, crc, payload = active(client)
    check("active revision", found_revision, revision)
    check("active CRC over what stands there", f"{crc:08X}", f"{zlib.crc32(payload):08X}")
    check("program", text(payload[:32]), program)
    bends, spare, last = struct.unpack(">HHi", payload[32:40])
    check("bend count, spare, last length", (bends, spare, last), (len(rows), 0, round(float(tail["length_mm"]) * 100)))
    for i, row in enumerate(rows):
        found = struct.unpack_from(">iii", payload, 40 + 12 * i)
        expected = (
            round(float(row["length_mm"]) * 100),
            round(float(row["rotation_deg"]) * 1000),
            round(float(row["angle_deg"]) * 1000),
        )
        check(f"bend {i + 1} at register {2020 + 6 * i}: length, rotation, angle", found, expected)

    # A commit for something that is not staged is refused, and nothing changes.
    words = struct.unpack(">4H", struct.pack(">II", revision + 1, 0xDEADBEEF))
    answer = client.write_registers(32, list(words), device_id=UNIT)
    if answer.isError():
        sys.exit(f"writing the commit: {answer}")
    deadline = time.monotonic() + 5
    while read(client, 32, 4) != bytes(8):
        if time.monotonic() > deadline:
            sys.exit("FAILED commit word: is not cleared")
    check("acknowledgement of a wrong commit", struct.unpack(">IH", read(client, 28, 3)), (revision + 1, 2))
    check("active table after it", active(client) == (found_revision, crc, payload), True)
    client.close()


main()
