# /// script
# requires-python = ">=3.10"
# dependencies = ["fast-downward-translate==26.6.0"]
# ///
"""Writes planning problems as the translator of Fast Downward writes them, and what a demonstrator was seen doing in them.

    python make.py [--out DIR]        (or: uv run make.py)

    blocksworld-4.sas  blocksworld-8.sas     blocks that all lie on the table at first
    logistics-2.sas    logistics-6.sas       packages to be sent by truck and airplane
    *.json                                   one run in each, of which only some values were observed, without its actions

The domains, blocksworld.pddl and logistics.pddl, lie beside this script. All variables are kept, also those that do not matter for the goal.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).parent


def translate(domain, problem, out):
    with tempfile.NamedTemporaryFile("w", suffix=".pddl") as file:
        file.write(problem)
        file.flush()
        flags = ["--keep-unimportant-variables", "--sas-file", str(out)]
        command = [sys.executable, "-m", "fast_downward.translate", *flags, str(HERE / domain), file.name]
        done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(done.stdout + done.stderr)


def blocksworld(n):
    """The problem, and the states in which one block after the other is put on the one before."""
    blocks = "abcdefgh"[:n]
    facts = " ".join(f"(clear {x}) (ontable {x})" for x in blocks)
    goal = " ".join(f"(on {x} {y})" for x, y in zip(blocks[1:], blocks))
    problem = (
        f"(define (problem blocksworld-{n}) (:domain blocksworld) (:objects {' '.join(blocks)})\n"
        f"  (:init (handempty) {facts})\n  (:goal (and {goal})))\n"
    )
    state = {x: f"ontable({x})" for x in blocks}
    seen = [dict(state)]
    for x, y in zip(blocks[1:], blocks):
        for value in (f"holding({x})", f"on({x}, {y})"):
            state[x] = value
            seen.append(dict(state))
    return problem, seen


def logistics(n_cities, n_places, n_planes, n_packages):
    """The problem, and the states in which one package after the other is sent on to the next city."""
    cities = range(1, n_cities + 1)
    place = lambda city, n: f"airport{city}" if n == 0 else f"place{city}-{n}"
    places = [place(city, n) for city in cities for n in range(1, n_places)]
    typed = [
        (places, "location"),
        ([f"airport{city}" for city in cities], "airport"),
        ([f"city{city}" for city in cities], "city"),
        ([f"truck{city}" for city in cities], "truck"),
        ([f"plane{n}" for n in range(1, n_planes + 1)], "airplane"),
        ([f"package{n}" for n in range(1, n_packages + 1)], "package"),
    ]
    state = {f"truck{city}": place(city, 0) for city in cities}
    state |= {f"plane{n}": place(1, 0) for n in range(1, n_planes + 1)}
    home = {n: ((n - 1) % n_cities + 1, 1 + (n - 1) // n_cities % (n_places - 1)) for n in range(1, n_packages + 1)}
    state |= {f"package{n}": place(*home[n]) for n in home}
    facts = [f"(at {thing} {where})" for thing, where in state.items()]
    facts += [f"(in-city {place(city, n)} city{city})" for city in cities for n in range(n_places)]
    next_city = {city: city % n_cities + 1 for city in cities}
    goal = " ".join(f"(at package{n} {place(next_city[city], where)})" for n, (city, where) in home.items())
    objects = "\n    ".join(" ".join(names) + " - " + kind for names, kind in typed)
    problem = (
        f"(define (problem logistics-{n_packages}) (:domain logistics)\n  (:objects {objects})\n"
        f"  (:init (= (total-cost) 0) {' '.join(facts)})\n  (:goal (and {goal}))\n  (:metric minimize (total-cost)))\n"
    )

    seen = []
    observe = lambda: seen.append({thing: where if "(" in where else f"at({thing}, {where})" for thing, where in state.items()})

    def move(vehicle, to):
        if state[vehicle] != to:
            state[vehicle] = to
            observe()

    def carry(package, vehicle, to):
        move(vehicle, state[package])
        state[package] = f"in({package}, {vehicle})"
        observe()
        move(vehicle, to)
        state[package] = to
        observe()

    observe()
    for n, (city, where) in home.items():
        plane = f"plane{(n - 1) % n_planes + 1}"
        carry(f"package{n}", f"truck{city}", place(city, 0))
        carry(f"package{n}", plane, place(next_city[city], 0))
        carry(f"package{n}", f"truck{next_city[city]}", place(next_city[city], where))
    return problem, seen


def main():
    parser = argparse.ArgumentParser(description="Write planning problems for `etude model import`, and demonstrations in them.")
    parser.add_argument("--out", metavar="DIR", type=Path, default=HERE, help="default: beside this script")
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    problems = {
        "blocksworld-4": ("blocksworld.pddl", blocksworld(4)),
        "blocksworld-8": ("blocksworld.pddl", blocksworld(8)),
        "logistics-2": ("logistics.pddl", logistics(2, 2, 1, 2)),
        "logistics-6": ("logistics.pddl", logistics(3, 3, 2, 6)),
    }
    for name, (domain, (problem, seen)) in problems.items():
        translate(domain, problem, out / f"{name}.sas")
        rows = ",\n".join("  " + json.dumps(state) for state in seen)
        (out / f"{name}.json").write_text(f"[\n{rows}\n]\n", encoding="utf-8")


if __name__ == "__main__":
    main()
