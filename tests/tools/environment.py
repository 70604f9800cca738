"""Prints what Gymnasium's own table says of an environment: `environment.py OUT ENV [NAME=VALUE ..]`, with the cost that a positive reward has.

The states are told by what the environment calculates from their values (Taxi), or by its grid, the other way round than the script in
examples/gymnasium does.
"""

import json
import sys
from collections import defaultdict

import gymnasium

STANDS = ["red", "green", "yellow", "blue"]
ACTIONS = {
    "Taxi-v4": ["south", "north", "east", "west", "pickup", "dropoff"],
    "FrozenLake-v1": ["left", "down", "right", "up"],
    "CliffWalking-v1": ["up", "right", "down", "left"],
}

out, name, *settings = sys.argv[1:]
settings = {name: json.loads(value) for name, value in (setting.split("=", 1) for setting in settings)}
environment = gymnasium.make(name, **settings).unwrapped
actions = ACTIONS[name]
if name == "Taxi-v4":
    names = ["taxi_row", "taxi_col", "passenger", "destination"]
    values = {
        int(environment.encode(row, col, passenger, destination)): [row, col, where, stand]
        for row in range(5)
        for col in range(5)
        for passenger, where in enumerate([*STANDS, "in_taxi"])
        for destination, stand in enumerate(STANDS)
    }
else:
    n_rows, n_cols = (4, 12) if name == "CliffWalking-v1" else environment.desc.shape
    names = ["row", "col"]
    values = {row * n_cols + col: [row, col] for row in range(n_rows) for col in range(n_cols)}

# An episode ends in a state that is entered so.
ends = {int(to) for of_state in environment.P.values() for ways in of_state.values() for _, to, _, ended in ways if ended}
choices = []
for state, of_state in environment.P.items():
    for action, ways in of_state.items():
        sums = defaultdict(lambda: [0.0, 0.0])
        for probability, to, reward, _ in ways:
            sums[int(to)][0] += float(probability)
            sums[int(to)][1] += float(probability) * (1.0 if reward > 0 else -float(reward))
        if state not in ends:
            ways = [[to, probability, cost / probability] for to, (probability, cost) in sums.items() if probability]
            choices.append([int(state), actions[action], ways])
start = [state for state, probability in enumerate(environment.initial_state_distrib) if probability]
told = {"names": names, "states": [values[state] for state in range(len(environment.P))], "start": start, "choices": choices}
with open(out, "w", encoding="utf-8") as file:
    json.dump(told, file)
