"""A bender's side of a delivery without a link: tables and areas as byte images, and what becomes of a commit.

Written from protocols/reference-modbus.md alone, no code of benderd's. modbus_bender.py and can/canopen_bender.py put
it on a link. Its own limit of the angle is narrower than the profile's, so that a whole delivery can end in code 8.
Run as a program, it goes through every code.
"""

import csv
import struct
import zlib

IDENTIFICATION, LAYOUT = 0x42454E44, 1
AUTOMATIC, BETWEEN_PARTS, FAULT, EMERGENCY_STOP = 1, 2, 4, 8
BENDS_MAX = 40
ANGLE_MAX = 185_000  # 0.001 degree

ID = struct.Struct(">II")  # revision, CRC
HEAD = struct.Struct(">32sHHi")  # program, bend count, spare, last length
ROW = struct.Struct(">iii")  # length, rotation, angle


def payload_of(area):
    """The payload at the start of an area, by its own bend count; nothing when that does not fit."""
    if len(area) < HEAD.size:
        return None
    bends = HEAD.unpack_from(area)[1]
    size = HEAD.size + bends * ROW.size
    return bytes(area[:size]) if bends <= BENDS_MAX and size <= len(area) else None


def table_of(path):
    """A CSV table in counts: the last length, and length, rotation, angle of each bend."""
    with open(path, newline="", encoding="utf-8") as file:
        *rows, tail = list(csv.DictReader(file))
    columns = (("length_mm", 100), ("rotation_deg", 1000), ("angle_deg", 1000))
    return round(float(tail["length_mm"]) * 100), [tuple(round(float(r[c]) * n) for c, n in columns) for r in rows]


def payload_for(program, table):
    """The payload of a table in counts, as the contract lays it out."""
    last, rows = table
    return HEAD.pack(program.encode("ascii"), len(rows), 0, last) + b"".join(ROW.pack(*row) for row in rows)


class Machine:
    """Between parts in automatic mode, with a program loaded and no table."""

    def __init__(self, program, bends):
        self.program = program.encode("ascii").ljust(32, b"\0")
        self.bends = bends
        self.state = AUTOMATIC | BETWEEN_PARTS
        self.heartbeat = 0
        self.staging = bytes(ID.size + HEAD.size + BENDS_MAX * ROW.size)
        self.active = bytes(HEAD.size + BENDS_MAX * ROW.size)
        self.active_id = (0, 0)
        self.ack = (0, 0)
        self.commit = (0, 0)

    def cycle(self):
        """One program cycle. Says what became of a commit, if there was one."""
        self.heartbeat = (self.heartbeat + 1) & 0xFFFF
        if self.commit[0] == 0:
            return None
        code, payload = self.examine(self.commit)
        if code == 1:
            self.active = payload.ljust(len(self.active), b"\0")
            self.active_id = self.commit
        self.ack = (self.commit[0], code)
        said = f"revision {self.commit[0]}, CRC {self.commit[1]:08X}: code {code}"
        self.commit = (0, 0)  # last
        return said

    def examine(self, commit):
        """The code of the contract, and the payload when it is 1."""
        staged, area = ID.unpack_from(self.staging.ljust(ID.size, b"\0")), self.staging[ID.size :]
        if commit != staged:
            return 2, None
        payload = payload_of(area)
        if payload is None or zlib.crc32(payload) != staged[1]:
            return 3, None
        if self.state & 0xF != AUTOMATIC | BETWEEN_PARTS:
            return 4, None
        program, bends, _, last = HEAD.unpack_from(payload)
        if program != self.program:
            return 5, None
        if bends != self.bends:
            return 6, None
        if staged[0] != (self.active_id[0] + 1) & 0xFFFFFFFF:
            return 7, None
        rows = ROW.iter_unpack(payload[HEAD.size :])
        if last < 0 or any(length < 0 or not 0 <= angle <= ANGLE_MAX for length, _, angle in rows):
            return 8, None
        return 1, payload


def main():
    def table(head=(b"P1", 1, 0, 5000), row=(12000, 0, 90000)):
        return HEAD.pack(*head) + ROW.pack(*row) * head[1]

    for expected, payload, change in [
        (1, table(), {}),
        (2, table(), {"commit": (1, 5)}),
        (3, table()[:-1], {}),
        (3, table(), {"commit": (1, 5), "staging": ID.pack(1, 5) + table()}),
        (3, table((b"P1", 41, 0, 5000)), {}),
        (4, table(), {"state": AUTOMATIC}),
        (4, table(), {"state": AUTOMATIC | BETWEEN_PARTS | EMERGENCY_STOP}),
        (5, table((b"P2", 1, 0, 5000)), {}),
        (6, table((b"P1", 2, 0, 5000)), {}),
        (7, table(), {"active_id": (7, 7)}),
        (8, table(row=(12000, 0, ANGLE_MAX + 1)), {}),
    ]:
        machine = Machine("P1", 1)
        machine.commit = (1, zlib.crc32(payload))
        machine.staging = ID.pack(*machine.commit) + payload
        for name, value in change.items():
            setattr(machine, name, value)
        before, revision = (machine.active, machine.active_id), machine.commit[0]
        said = machine.cycle()
        if machine.ack != (revision, expected) or machine.commit != (0, 0):
            raise SystemExit(f"FAILED machine.py: {said}, expected code {expected}")
        if (expected == 1) != ((machine.active, machine.active_id) != before):
            raise SystemExit(f"FAILED machine.py: {said}, and the active table is wrong")
    print("ok  machine.py: acknowledges with 1, refuses with 2 to 8")


if __name__ == "__main__":
    main()
