"""An independent bender: the controller's side of protocols/reference-modbus.md on a server of pymodbus's.

Usage: modbus_bender.py --program NAME --bends N (--port PORT | --serial PATH)
Port 0 takes a free one. Says where it listens, then what becomes of each commit.
"""

import argparse
import asyncio
import struct

from pymodbus.constants import ExcCodes
from pymodbus.server import ModbusSerialServer, ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

from machine import ID, IDENTIFICATION, LAYOUT, Machine

UNIT, CYCLE = 1, 0.01
STATUS, COMMIT, STAGING, ACTIVE = 0, 32, 1000, 2000
READ, WRITE = 3, 16


def status(m):
    state = struct.pack(">IHHHH4x", IDENTIFICATION, LAYOUT, m.heartbeat, m.state, m.bends)
    ack = struct.pack(">IH2x", *m.ack)
    return state + m.program + ID.pack(*m.active_id) + ack + ID.pack(*m.commit)


class Registers:
    """The machine's areas by register address."""

    def __init__(self, machine):
        self.machine = machine

    def device(self):
        """What pymodbus needs to refuse an address itself; the values come from `access`."""

        def area(address, count, readonly):
            return SimData(address, count=count, values=0, datatype=DataType.REGISTERS, readonly=readonly)

        m = self.machine
        areas = [
            area(STATUS, COMMIT, True),
            area(COMMIT, 4, False),
            area(STAGING, len(m.staging) // 2, False),
            area(ACTIVE, len(m.active) // 2, True),
        ]
        return SimDevice(UNIT, simdata=areas, action=self.access)

    async def access(self, function, first, address, count, registers, values):
        """A request, before pymodbus carries it out on `registers` (which start at address `first`)."""
        m = self.machine
        if function not in (READ, WRITE):
            return ExcCodes.ILLEGAL_FUNCTION
        if function == READ:
            start = max(a for a in (STATUS, STAGING, ACTIVE) if a <= address)
            image = {STATUS: status(m), STAGING: m.staging, ACTIVE: m.active}[start]
            part = image[2 * (address - start) : 2 * (address - start + count)]
            registers[address - first : address - first + count] = struct.unpack(f">{count}H", part)
            return None
        data = struct.pack(f">{count}H", *values)
        if address >= STAGING:
            at = 2 * (address - STAGING)
            m.staging = m.staging[:at] + data + m.staging[at + len(data) :]
        elif (address, count) == (COMMIT, 4):
            m.commit = ID.unpack(data)
        else:  # half a commit
            return ExcCodes.ILLEGAL_VALUE
        return None


async def main():
    options = argparse.ArgumentParser()
    options.add_argument("--program", required=True)
    options.add_argument("--bends", type=int, required=True)
    where = options.add_mutually_exclusive_group(required=True)
    where.add_argument("--port", type=int)
    where.add_argument("--serial")
    options = options.parse_args()

    machine = Machine(options.program, options.bends)
    device = Registers(machine).device()
    if options.serial:
        # A pseudo terminal has no parity, and pyserial fails when it asks for one there a second time.
        server = ModbusSerialServer(device, port=options.serial, baudrate=19200, parity="N")
        await server.serve_forever(background=True)
        place = options.serial
    else:
        server = ModbusTcpServer(device, address=("127.0.0.1", options.port))
        await server.serve_forever(background=True)
        host, port = server.transport.sockets[0].getsockname()
        place = f"{host}:{port}"
    print(f"pymodbus as a bender listens on {place}", flush=True)
    while True:
        said = machine.cycle()
        if said:
            print(said, flush=True)
        await asyncio.sleep(CYCLE)


asyncio.run(main())
