# /// script
# requires-python = ">=3.10"
# dependencies = ["gymnasium[toy-text]==1.4.0"]
# ///
"""Writes the transition table `P` of a Gymnasium environment as JSON, for `etude model import`.

    python export.py Taxi-v4 --out taxi.json
    python export.py FrozenLake-v1 --set is_slippery=false --out frozen-lake.json
    etude model import taxi.json --cost dropoff=1 --out model.json

It works for every environment that has a table `P[state][action] = [(probability, next state, reward, terminated), ..]`. States get named
attributes where the environment says what its numbers mean: by `decode` (Taxi), or as cells of a grid (FrozenLake, CliffWalking); else their number
is their only attribute. Actions have names where this script knows them, else their numbers.
"""

import argparse
import json
import sys
from pathlib import Path

import gymnasium

# What environments number, but name in their documentation alone.
ACTIONS = {
    "TaxiEnv": ["south", "north", "east", "west", "pickup", "dropoff"],
    "FrozenLakeEnv": ["left", "down", "right", "up"],
    "CliffWalkingEnv": ["up", "right", "down", "left"],
}
STANDS = ["red", "green", "yellow", "blue"]


def describe(environment, n_states):
    """The names of the attributes, and the values of every state."""
    if type(environment).__name__ == "TaxiEnv":
        places = [*STANDS, "in_taxi"]
        decoded = (map(int, environment.decode(state)) for state in range(n_states))
        states = [[row, col, places[passenger], STANDS[destination]] for row, col, passenger, destination in decoded]
        return ["taxi_row", "taxi_col", "passenger", "destination"], states
    shape = getattr(environment, "shape", None) or (getattr(environment, "nrow", 0), getattr(environment, "ncol", 0))
    if len(shape) == 2 and shape[0] * shape[1] == n_states:
        return ["row", "col"], [list(divmod(state, int(shape[1]))) for state in range(n_states)]
    return [{"name": "state", "kind": "category"}], [[state] for state in range(n_states)]


def export(environment):
    """What is written, as values of JSON."""
    table = getattr(environment, "P", None)
    if table is None:
        raise SystemExit(f"{type(environment).__name__} has no table `P`")
    n_states = len(table)
    names, states = describe(environment, n_states)
    document = {"format": "etude.gymnasium.v1", "environment": environment.spec.id, "attributes": names}
    if type(environment).__name__ in ACTIONS:
        document["actions"] = ACTIONS[type(environment).__name__]
    document["states"] = states
    initial = getattr(environment, "initial_state_distrib", None)
    if initial is not None:
        document["start"] = [state for state in range(n_states) if initial[state] > 0]
    document["P"] = {
        str(state): {
            str(action): [[float(p), int(to), float(reward), bool(ended)] for p, to, reward, ended in outcomes]
            for action, outcomes in sorted(table[state].items())
        }
        for state in range(n_states)
    }
    return document


def write(document, out):
    """A state a line."""
    compact = lambda value: json.dumps(value, separators=(",", ":"))
    lines = [f'  "{name}": {compact(value)},\n' for name, value in document.items() if name != "P"]
    rows = [f'    "{state}": {compact(actions)}' for state, actions in document["P"].items()]
    out.write("{\n" + "".join(lines) + '  "P": {\n' + ",\n".join(rows) + "\n  }\n}\n")


def setting(text):
    name, value = text.split("=", 1)
    try:
        return name, json.loads(value)
    except json.JSONDecodeError:
        return name, value


def main():
    parser = argparse.ArgumentParser(description="Write the transition table of a Gymnasium environment as JSON.")
    parser.add_argument("environment", metavar="ENV", help="such as Taxi-v4")
    parser.add_argument("--set", metavar="NAME=VALUE", type=setting, action="append", default=[], help="a setting of the environment")
    parser.add_argument("--out", metavar="FILE", type=Path, help="default: standard output")
    arguments = parser.parse_args()
    document = export(gymnasium.make(arguments.environment, **dict(arguments.set)).unwrapped)
    if arguments.out is None:
        write(document, sys.stdout)
    else:
        with arguments.out.open("w", encoding="utf-8") as out:
            write(document, out)


if __name__ == "__main__":
    main()
