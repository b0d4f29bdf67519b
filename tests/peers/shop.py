"""A shop of its own: bends a bracket, has it scanned and measured, and asks `benderd correct` for the next table, five tubes long.

It knows the contract of `correct` and `reconstruct` only, as an outside program would; how its tubes spring back is its own.
Usage: shop.py BINARY PART.toml [SEEDS]
"""
import json
import math
import random
import subprocess
import sys
import tempfile
from pathlib import Path

ANGLES_DEG = [90.0, 45.0, 60.0, 30.0]
CLR_MM = 50.8
TUBES = 5
TOLERANCE_DEG = 0.5

TUBE = """name = "formed"
[tube]
od_mm = 25.4
wall_mm = 1.65
material = "304"
[die]
clr_mm = 50.8
{bends}[end]
length_mm = {last:.5f}
[tolerance]
envelope_mm = 1.5
angle_deg = 0.5
rotation_deg = 0.5
length_mm = 0.8
"""
BEND = "[[bend]]\nlength_mm = {:.5f}\nrotation_deg = {:.5f}\nangle_deg = {:.5f}\nradius_mm = {:.5f}\n"


class Bender:
    """Springs back by a share of the angle and by what opens at the ends of the arc, and never twice alike."""

    def __init__(self, chance):
        self.chance = chance
        self.share = chance.gauss(0.026, 0.005)
        self.opened_deg = chance.gauss(0.8, 0.25)
        self.batch = math.exp(chance.gauss(0.0, 0.08))
        self.slip_mm = chance.gauss(0.0, 0.05)
        self.own_deg = [chance.gauss(0.0, 0.1) for _ in ANGLES_DEG]

    def form(self, table):
        bends = []
        for bend, own_deg in zip(table["bends"], self.own_deg):
            turned = bend["angle_deg"]
            sprung = self.batch * (self.share * turned + self.opened_deg * math.tanh(turned / 25.0))
            sprung += own_deg + self.chance.gauss(0.0, 0.07)
            length_mm = bend["length_mm"] + self.slip_mm + self.chance.gauss(0.0, 0.06)
            rotation_deg = (bend["rotation_deg"] + self.chance.gauss(0.0, 0.05) + 180.0) % 360.0 - 180.0
            bends.append((length_mm, rotation_deg, turned - sprung, CLR_MM * (1.0 + 0.65 * sprung / turned)))
        return bends, table["last_length_mm"] + self.chance.gauss(0.0, 0.1)


def run(binary, *words, allowed=(0,)):
    done = subprocess.run([binary, *map(str, words)], capture_output=True, text=True, check=False)
    if done.returncode not in allowed:
        sys.exit(f"{' '.join(map(str, words))}: exit {done.returncode}\n{done.stdout}{done.stderr}")
    return done.stdout


def job(binary, part, seed, folder):
    bender = Bender(random.Random(seed))
    history = {"key": {"bender": "b1", "lubrication": "std"}, "batch": f"h{seed}", "parts": []}
    file, tube, scan = folder / "history.json", folder / "tube.toml", folder / "scan.ply"

    def ask():
        file.write_text(json.dumps(history))
        return json.loads(run(binary, "correct", "--nominal", part, "--history", file, "--json", allowed=(0, 1)))

    answer = ask()
    assert answer["verdict"] == "first_piece", answer
    for number in range(1, TUBES + 1):
        table = {name: answer["commanded"][name] for name in ("bends", "last_length_mm")}
        bends, last_mm = bender.form(table)
        tube.write_text(TUBE.format(bends="".join(BEND.format(*bend) for bend in bends), last=last_mm))
        run(binary, "simulate", "scan", "--part", tube, "--seed", 100 * seed + number, "--out", scan, "--views", 2)
        measured = json.loads(run(binary, "reconstruct", scan, "--nominal", part, "--json"))
        entry = {"commanded": table, "measured": measured, "revision": number, "scan_id": f"{seed}-{number}"}
        history["parts"].append(entry)
        answer = ask()
        worst_deg = max(abs(bend[2] - drawn) for bend, drawn in zip(bends, ANGLES_DEG))
        print(f"job {seed}, tube {number}: worst angle {worst_deg:.2f} degrees off, {answer['verdict']}")
        if number > 1:
            assert worst_deg < TOLERANCE_DEG and answer["verdict"] == "in_tolerance", answer


def main():
    binary, part = sys.argv[1:3]
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(1, int(sys.argv[3] if len(sys.argv) > 3 else 12) + 1):
            job(binary, part, seed, Path(folder))


main()
