"""A delivery by the canopen package alone, or what a delivery left behind: keeps canopen_bender.py honest.

Usage: canopen_peer.py deliver TABLE.csv PROGRAM REVISION            to node 5 on vcan0, as benderd would
       canopen_peer.py compare LOG TABLE.csv PROGRAM REVISION        the last line of canopen_bender.py's log
"""

import json
import struct
import sys
import time
import zlib
from pathlib import Path

import canopen

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from machine import AUTOMATIC, BETWEEN_PARTS, ID, IDENTIFICATION, LAYOUT, payload_for, table_of  # noqa: E402

STATUS, STAGING, COMMIT, ACTIVE = 0x2000, 0x2001, 0x2002, 0x2003


def check(what, found, expected):
    if found != expected:
        sys.exit(f"FAILED {what}: found {found!r}, expected {expected!r}")
    print(f"ok  {what}: {found!r}")


class Client:
    """Reads and writes whole objects; needs no object dictionary."""

    def __init__(self):
        self.network = canopen.Network()
        self.network.connect(interface="socketcan", channel="vcan0")
        self.sdo = self.network.add_node(canopen.RemoteNode(5, canopen.ObjectDictionary())).sdo
        self.sdo.RESPONSE_TIMEOUT = 5

    def read(self, index):
        return self.sdo.upload(index, 0)

    def status(self):
        """Identification, layout, state and bend count; heartbeat; active; acknowledgement; commit; program."""
        image = self.read(STATUS)
        identification, layout, heartbeat, state, bends = struct.unpack_from(">IHHHH", image)
        known = identification, layout, state, bends
        active, ack, commit = ID.unpack_from(image, 12), struct.unpack_from(">IH", image, 20), ID.unpack_from(image, 28)
        return known, heartbeat, active, ack, commit, image[36:].rstrip(b"\0").decode("ascii")

    def write(self, index, data):
        self.sdo.download(index, 0, data)

    def aborts(self, what, code, action):
        try:
            action()
        except canopen.SdoAbortedError as abort:
            check(what, f"{abort.code:#010x}", f"{code:#010x}")
        else:
            sys.exit(f"FAILED {what}: was taken, expected abort {code:#010x}")

    def commit(self, commit):
        """Writes it and waits until it is dealt with."""
        self.write(COMMIT, ID.pack(*commit))
        deadline = time.monotonic() + 5
        while (status := self.status())[4] != (0, 0):
            if time.monotonic() > deadline:
                sys.exit("FAILED commit: is not cleared")
        return status


def deliver(path, program, revision):
    table = table_of(path)
    payload = payload_for(program, table)
    crc = zlib.crc32(payload)
    client = Client()
    known, heartbeat, active, _, commit, loaded = client.status()
    expected = (IDENTIFICATION, LAYOUT, AUTOMATIC | BETWEEN_PARTS, len(table[1]))
    check("identification, layout, state, bend count", known, expected)
    check("active revision, commit, program", (active[0], commit, loaded), (revision - 1, (0, 0), program))
    client.write(STAGING, ID.pack(revision, crc) + payload)
    check("staging reads back as written", client.read(STAGING) == ID.pack(revision, crc) + payload, True)
    check("the heartbeat has moved", client.status()[1] != heartbeat, True)
    _, _, active, ack, _, _ = client.commit((revision, crc))
    check("active revision, CRC, acknowledgement", (active, ack), ((revision, crc), (revision, 1)))
    check("the active table is the payload", client.read(ACTIVE) == payload, True)

    _, _, active, ack, _, _ = client.commit((revision + 1, 0xDEADBEEF))
    check("a wrong commit: active, acknowledgement", (active, ack), ((revision, crc), (revision + 1, 2)))
    check("the active table is the payload still", client.read(ACTIVE) == payload, True)
    client.aborts("writing the active table", 0x06010002, lambda: client.write(ACTIVE, payload))
    client.aborts("reading the commit", 0x06010001, lambda: client.read(COMMIT))
    client.aborts("half a commit", 0x06070010, lambda: client.write(COMMIT, bytes(4)))
    client.aborts("another object", 0x06020000, lambda: client.read(0x2004))
    client.network.disconnect()


def compare(log, path, program, revision):
    """What the bender said when it was terminated, against the table."""
    last = Path(log).read_text(encoding="utf-8").splitlines()[-1]
    if not last.startswith("active "):
        sys.exit(f"FAILED {log}: the bender's last line is {last!r}, expected its active table: did it crash?")
    length, rows = table = table_of(path)
    expected = {"revision": revision, "crc": zlib.crc32(payload_for(program, table)), "program": program}
    expected |= {"last": length, "rows": [list(row) for row in rows]}
    check("active table at the end", json.loads(last.removeprefix("active ")), expected)


def main():
    match sys.argv[1:]:
        case ["deliver", path, program, revision]:
            deliver(path, program, int(revision))
        case ["compare", log, path, program, revision]:
            compare(log, path, program, int(revision))
        case _:
            sys.exit(__doc__)


main()
