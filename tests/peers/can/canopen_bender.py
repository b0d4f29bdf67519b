"""An independent bender: a node of the canopen package whose objects are the areas of protocols/reference-modbus.md.

Object   sub-index 0 of   access
0x2000   status           ro      as a Modbus controller's, in another order: see `status`
0x2001   staging          rw      revision, CRC, payload
0x2002   commit           wo      revision, CRC
0x2003   active           ro      payload, as long as its bend count says
All are DOMAIN, high byte first. Says what becomes of each commit and, when it is terminated, what is active.
Usage: canopen_bender.py --program NAME --bends N [--node ID] [--channel NAME]
"""

import argparse
import json
import signal
import struct
import sys
import threading
from pathlib import Path

import canopen
from canopen.objectdictionary import DOMAIN, ObjectDictionary, ODVariable

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from machine import HEAD, ID, IDENTIFICATION, LAYOUT, ROW, Machine, payload_of  # noqa: E402

CYCLE = 0.01
STATUS, STAGING, COMMIT, ACTIVE = 0x2000, 0x2001, 0x2002, 0x2003
LENGTH_DOES_NOT_MATCH = 0x06070010


def status(m):
    state = struct.pack(">IHHHH", IDENTIFICATION, LAYOUT, m.heartbeat, m.state, m.bends)
    return state + ID.pack(*m.active_id) + struct.pack(">IH2x", *m.ack) + ID.pack(*m.commit) + m.program


class Objects:
    """The machine's areas by object; canopen calls from a thread of its own."""

    def __init__(self, machine):
        self.machine = machine
        self.lock = threading.Lock()

    def dictionary(self):
        dictionary = ObjectDictionary()
        for name, index, access in (
            ("status", STATUS, "ro"),
            ("staging", STAGING, "rw"),
            ("commit", COMMIT, "wo"),
            ("active", ACTIVE, "ro"),
        ):
            variable = ODVariable(name, index, 0)
            variable.data_type, variable.access_type = DOMAIN, access
            dictionary.add_object(variable)
        return dictionary

    def read(self, index, **_):
        m = self.machine
        with self.lock:
            return {STATUS: lambda: status(m), STAGING: lambda: m.staging, ACTIVE: lambda: payload_of(m.active)}[
                index
            ]()

    def write(self, index, data, **_):
        with self.lock:
            if index == STAGING:
                self.machine.staging = bytes(data)
            elif len(data) == ID.size:
                self.machine.commit = ID.unpack(data)
            else:
                raise canopen.SdoAbortedError(LENGTH_DOES_NOT_MATCH)

    def active(self):
        m = self.machine
        program, _, _, last = HEAD.unpack_from(m.active)
        rows = list(ROW.iter_unpack(payload_of(m.active)[HEAD.size :]))
        program = program.rstrip(b"\0").decode("ascii")
        return {"revision": m.active_id[0], "crc": m.active_id[1], "program": program, "last": last, "rows": rows}


def main():
    options = argparse.ArgumentParser()
    options.add_argument("--program", required=True)
    options.add_argument("--bends", type=int, required=True)
    options.add_argument("--node", type=int, default=5)
    options.add_argument("--channel", default="vcan0")
    options = options.parse_args()

    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})  # for sigtimedwait below
    objects = Objects(Machine(options.program, options.bends))
    node = canopen.LocalNode(options.node, objects.dictionary())
    node.add_read_callback(objects.read)
    node.add_write_callback(objects.write)
    network = canopen.Network()
    network.connect(interface="socketcan", channel=options.channel)
    network.add_node(node)
    print(f"canopen as a bender listens on {options.channel}, node {options.node}", flush=True)
    while signal.sigtimedwait({signal.SIGTERM}, CYCLE) is None:
        with objects.lock:
            said = objects.machine.cycle()
        if said:
            print(said, flush=True)
    network.disconnect()
    print("active " + json.dumps(objects.active()), flush=True)


main()
