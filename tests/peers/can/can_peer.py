"""Reads the bus of one `benderd push` with cantools: what the DBC says of the log's frames must be the CSV's table.

Knows the DBC, the frames' meaning and the table, no code of benderd's. The log is candump's (-L), from some status
cycles before the delivery to some after it.
Usage: can_peer.py BENDER.dbc LOG TABLE.csv PROGRAM REVISION
"""

import statistics
import sys
import zlib
from itertools import groupby, pairwise
from pathlib import Path

import can
import cantools

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from machine import AUTOMATIC, BETWEEN_PARTS, IDENTIFICATION, LAYOUT, payload_for, table_of  # noqa: E402

READ_STAGING, WRITE_STAGING, READ_ACTIVE = 0, 1, 2
FRAMES = {
    "STATUS_STATE": 0x310,
    "STATUS_ITEM": 0x311,
    "TABLE_ITEM": 0x320,
    "TABLE_ECHO": 0x321,
    "COMMIT": 0x322,
    "COMMIT_ECHO": 0x323,
}
STATUS = "Identification ActiveRevision ActiveCrc AckRevision AckCode CommitRevision CommitCrc".split()
STATUS_ITEMS = dict(enumerate(STATUS)) | {8 + i: f"Program{i}" for i in range(8)}
TABLE_ITEMS = dict(enumerate("Revision Crc BendCount LastLength Length Rotation Angle Program".split()))
COUNTS = {"LastLength": 100, "Length": 100, "Rotation": 1000, "Angle": 1000}  # of a mm, of a degree


def check(what, found, expected):
    if found != expected:
        sys.exit(f"FAILED {what}: found {found!r}, expected {expected!r}")
    print(f"ok  {what}: {found!r}")


def show(values):
    return " ".join(f"{name}={value}" for name, value in values.items())


def decoded(dbc, log):
    """(time, message name, values) of each frame; lengths and angles back in counts, so that a wrong factor shows."""
    database = cantools.database.load_file(dbc)
    for name, frame_id in FRAMES.items():
        found = [m.frame_id for m in database.messages if m.name == name]
        if found != [frame_id]:
            sys.exit(f"FAILED {dbc}: {name} has the ids {found}, expected {frame_id:#x} alone")
    with can.CanutilsLogReader(log) as frames:
        for frame in frames:
            raw = f"frame {frame.arbitration_id:03X}#{frame.data.hex().upper()}"
            if frame.is_extended_id or frame.is_error_frame or frame.arbitration_id not in FRAMES.values():
                sys.exit(f"FAILED {raw}: no such frame in {dbc}")
            message = database.get_message_by_frame_id(frame.arbitration_id)
            try:
                values = message.decode(bytes(frame.data), decode_choices=False)
            except cantools.Error as error:
                sys.exit(f"FAILED {raw}, {message.name} by {dbc}: {error}")
            yield frame.timestamp, message.name, {n: round(v * COUNTS.get(n, 1)) for n, v in values.items()}


def item(values, names):
    """The name and value that the multiplexer selects."""
    name = names.get(values["Item"])
    if name not in values:
        sys.exit(f"FAILED item {values['Item']}: expected {name}, the DBC says {show(values)}")
    return name, values[name]


def text(parts):
    return b"".join(part.to_bytes(4, "little") for part in parts).rstrip(b"\0").decode("ascii")


def cycles(frames):
    """The status, cycle by cycle; the first and the last may be cut off by the log."""
    of_status = [(at, name, values) for at, name, values in frames if name.startswith("STATUS")]
    whole = []
    for cycle, group in groupby(of_status, key=lambda frame: frame[2]["Cycle"]):
        group = list(group)
        items = [item(values, STATUS_ITEMS) for _, name, values in group if name == "STATUS_ITEM"]
        states = [(at, values) for at, name, values in group if name == "STATUS_STATE"]
        whole.append((cycle, states, items))
    whole = whole[1:-1]
    for cycle, states, items in whole:
        if len(states) != 1 or sorted(n for n, _ in items) != sorted(STATUS_ITEMS.values()):
            sys.exit(f"FAILED cycle {cycle}: {len(states)} STATUS_STATE and {items}, expected one of each item")
    if len(whole) < 3:
        sys.exit(f"FAILED status: {len(whole)} whole cycles in the log, expected 3 and more")
    return [(states[0][0], states[0][1] | dict(items)) for _, states, items in whole]


def check_status(frames, program, bends, revision, crc):
    status = cycles(frames)
    jumps = [(b["Cycle"] - a["Cycle"]) % 256 for (_, a), (_, b) in pairwise(status)]
    check("cycles counted one by one", set(jumps), {1})
    beats = [(b["Heartbeat"] - a["Heartbeat"]) % 65536 for (_, a), (_, b) in pairwise(status)]
    check("heartbeat: counts", all(0 < beat < 32768 for beat in beats), True)
    period = statistics.median(b - a for (a, _), (b, _) in pairwise(status))
    print(f"    {len(status)} whole status cycles, {1000 * period:.0f} ms apart (median)")
    for when, values, active in (("before", status[0][1], revision - 1), ("after", status[-1][1], revision)):
        known = (values["Identification"], values["Layout"], values["State"] & 0xF, values["BendCount"])
        expected = (IDENTIFICATION, LAYOUT, AUTOMATIC | BETWEEN_PARTS, bends)
        check(f"{when}: identification, layout, state, bend count", known, expected)
        check(f"{when}: program", text(values[f"Program{i}"] for i in range(8)), program)
        check(f"{when}: active revision", values["ActiveRevision"], active)
    last = status[-1][1]
    check("after: active CRC", f"{last['ActiveCrc']:08X}", f"{crc:08X}")
    check("after: acknowledged revision, code", (last["AckRevision"], last["AckCode"]), (revision, 1))
    check("after: no commit is left", (last["CommitRevision"], last["CommitCrc"]), (0, 0))


def table_in(items):
    """A table out of items by (name, row): last length, rows, program."""
    try:
        rows = [tuple(items[name, i] for name in ("Length", "Rotation", "Angle")) for i in range(items["BendCount", 0])]
        return items["LastLength", 0], rows, text(items["Program", i] for i in range(8))
    except KeyError as missing:
        sys.exit(f"FAILED table: item and row {missing} never came")


def check_table(frames, expected, revision, crc):
    asked, echoed, commits, last_write = {}, {}, [], None
    for number, (_, name, values) in enumerate(frames):
        if name in ("COMMIT", "COMMIT_ECHO"):
            commits.append((number, name, values))
        elif name in ("TABLE_ITEM", "TABLE_ECHO"):
            operation, row = values["Operation"], values["Row"]
            key, value = item(values, TABLE_ITEMS)
            if name == "TABLE_ECHO" and values["Result"] != 0:
                sys.exit(f"FAILED {name}: refused: {show(values)}")
            (asked if name == "TABLE_ITEM" else echoed).setdefault(operation, {})[key, row] = value
            if operation == WRITE_STAGING:
                last_write = number

    written = asked.get(WRITE_STAGING, {})
    check("table written to staging", table_in(written), expected)
    check("revision and CRC written", (written.get(("Revision", 0)), written.get(("Crc", 0))), (revision, crc))
    for what, operation in (("echo of each item written", WRITE_STAGING), ("each item read back", READ_STAGING)):
        found = echoed.get(operation, {})
        check(f"{what}: differing", {k: found.get(k) for k in written if found.get(k) != written[k]}, {})
    check("active table read", table_in(echoed.get(READ_ACTIVE, {})), expected)
    check("commit and its echo", [name for _, name, _ in commits], ["COMMIT", "COMMIT_ECHO"])
    for _, name, values in commits:
        check(f"{name}: revision, CRC", (values["Revision"], values["Crc"]), (revision, crc))
    check("commit comes after the last write", commits[0][0] > last_write, True)


def main():
    if len(sys.argv) != 6:
        sys.exit("usage: can_peer.py BENDER.dbc LOG TABLE.csv PROGRAM REVISION")
    dbc, log, path, program, revision = *sys.argv[1:5], int(sys.argv[5])
    last, rows = table = table_of(path)
    crc = zlib.crc32(payload_for(program, table))
    frames = list(decoded(dbc, log))
    check_status(frames, program, len(rows), revision, crc)
    check_table(frames, (last, rows, program), revision, crc)


main()
