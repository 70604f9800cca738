# /// script
# requires-python = ">=3.10"
# dependencies = ["gymnasium[toy-text]==1.4.0"]
# ///
"""Writes Gymnasium's Taxi environment as etude models, and one run of it as a demonstration.

    python export.py [--out DIR]        (or: uv run export.py)

A taxi on a 5x5 grid fetches a passenger from one of four coloured stands and takes them to another:

    +---------+
    |R: | : :G|      ":" can be driven through, "|" is a wall.
    | : | : : |      Walls stop east and west only, never north and south,
    | : : : : |      and the middle row has none.
    | | : | : |
    |Y| : |B: |
    +---------+

Everything is read from the environment itself: what actions do from its table `P`, attribute values from its
`decode`, the demonstration by stepping it. The files, by default beside this script:

    model.json          the demonstrator's own body: all six actions
    no-west.json        the same world for a body that cannot drive west
    costly-pickup.json  the same world for a body whose pickup costs ten times as much
    demonstration.json  the states observed in one optimal run, without its actions
    request.json        that demonstration, asking for the policy of the body that cannot drive west

To try them against a running service:

    curl -X PUT --json @no-west.json http://localhost:8080/v1/models/taxi-no-west
    curl --json @request.json http://localhost:8080/v1/policies

Which run is demonstrated. Given the map, a shortest run drives west only where it must. So whenever west is used, a
body without it cannot deliver, and the most it can do is to pick the passenger up. Of all initial states whose
optimal run drives west and whose passenger that body can still pick up, we take the one with the longest optimal
run (the lowest state number on ties): from R to fetch a passenger at G, around the walls, and back to R. Such a body
has to decide how far to follow, as no drive east can be undone: to the passenger, or only part of the way to stay
near the destination? The weights decide.
"""

import argparse
import json
from collections import deque
from pathlib import Path

import gymnasium

# The environment numbers its actions and the passenger's places, but names them only in its documentation.
# What an action name promises (change of row, change of column) is checked against the table; colours come from `locs_colors`.
ACTIONS = {"south": (1, 0), "north": (-1, 0), "east": (0, 1), "west": (0, -1), "pickup": (0, 0), "dropoff": (0, 0)}
NAMES = list(ACTIONS)
COLOURS = {(255, 0, 0): "red", (0, 255, 0): "green", (255, 255, 0): "yellow", (0, 0, 255): "blue"}
ATTRIBUTES = [
    {"name": "taxi_row", "kind": "number", "weight": 1},
    {"name": "taxi_col", "kind": "number", "weight": 1},
    {"name": "passenger", "kind": "category", "weight": 4},  # the task is about the passenger and the destination
    {"name": "destination", "kind": "category", "weight": 4},
]
ACTION_COST = 0.3


def check(condition, message):
    if not condition:
        raise SystemExit(f"not the Taxi environment this script knows: {message}")


def read_states(taxi):
    """The attribute values of every state, in the environment's numbering."""
    stands = [COLOURS[tuple(rgb)] for rgb in taxi.locs_colors]
    places = [*stands, "in_taxi"]
    check(sorted(taxi.P) == list(range(500)), "its states are not 0 to 499")
    decoded = [tuple(map(int, taxi.decode(state))) for state in range(500)]
    return [[row, col, places[passenger], stands[destination]] for row, col, passenger, destination in decoded]


def read_transitions(taxi, states):
    """The transitions (from, action, to) by `from`, and those of them that end an episode.

    An action without effect is no transition, and nothing leaves a state that is entered by ending an episode.
    """
    table, ending = {}, set()
    for state in range(len(states)):
        check(sorted(taxi.P[state]) == list(range(len(NAMES))), f"the actions of state {state}")
        table[state] = []
        for action, outcomes in sorted(taxi.P[state].items()):
            check(len(outcomes) == 1 and outcomes[0][0] == 1, f"action {action} in state {state} is not deterministic")
            _, to, _, terminated = outcomes[0]
            move = (state, NAMES[action], int(to))
            if terminated:
                ending.add(move)
            if to != state:
                table[state].append(move)
                effect = (states[to][0] - states[state][0], states[to][1] - states[state][1])
                check(effect == ACTIONS[NAMES[action]], f"action {action} is not {NAMES[action]} in state {state}")
    for terminal in {to for _, _, to in ending}:
        table[terminal] = []
    return table, ending


def shortest(table, start, is_goal, without=()):
    """The shortest run, a list of transitions, from `start` up to one that is a goal; None if there is none.

    Breadth first, actions in the environment's order: of several shortest runs, the one that takes the
    lowest-numbered action where they part.
    """
    runs, queue = {start: []}, deque([start])
    while queue:
        state = queue.popleft()
        for move in table[state]:
            _, action, to = move
            if action in without:
                continue
            if is_goal(move):
                return runs[state] + [move]
            if to not in runs:
                runs[to] = runs[state] + [move]
                queue.append(to)
    return None


def choose_run(table, ending, initial):
    """The run to demonstrate, by the criterion stated above."""
    best = []
    for start in initial:
        run = shortest(table, start, lambda move: move in ending)
        drives_west = any(action == "west" for _, action, _ in run)
        picks_up = shortest(table, start, lambda move: move[1] == "pickup", without=["west"])
        if drives_west and picks_up and len(run) > len(best):
            best = run
    return best


def perform(env, run):
    """Has the environment itself perform `run`; the observed states, as numbers."""
    env.reset(seed=0)
    env.unwrapped.s = run[0][0]
    observed = [run[0][0]]
    for move in run:
        state, _, terminated, truncated, _ = env.step(NAMES.index(move[1]))
        check(state == move[2], f"its table and its steps disagree about {move}")
        check(terminated == (move is run[-1]) and not truncated, f"the episode does not end with {run[-1]}")
        observed.append(int(state))
    return observed


def compact(value):
    return json.dumps(value, separators=(",", ":"))


def lines(rows, indent):
    """The inside of a JSON list or object, one row a line."""
    return ",\n".join(" " * indent + row for row in rows)


def model_json(states, table, actions, costs={}):
    """A model with the given actions. Four states a line (they differ in destination); all that leave one state a line."""
    moves = [[move for move in table[state] if move[1] in actions] for state in table]
    return f"""{{
  "attributes": [
{lines(map(compact, ATTRIBUTES), 4)}
  ],
  "actions": [
{lines((compact({"name": name, "cost": costs.get(name, ACTION_COST)}) for name in actions), 4)}
  ],
  "dynamics": {{
    "kind": "table",
    "states": [
{lines((",".join(map(compact, states[i : i + 4])) for i in range(0, len(states), 4)), 6)}
    ],
    "transitions": [
{lines((",".join(map(compact, leaving)) for leaving in moves if leaving), 6)}
    ]
  }}
}}
"""


def main():
    parser = argparse.ArgumentParser(description="Write Gymnasium's Taxi environment as etude models and a demonstration.")
    parser.add_argument("--out", metavar="DIR", type=Path, default=Path(__file__).parent, help="default: beside this script")
    out = parser.parse_args().out

    env = gymnasium.make("Taxi-v4")
    taxi = env.unwrapped
    states = read_states(taxi)
    table, ending = read_transitions(taxi, states)
    initial = [state for state in range(len(states)) if taxi.initial_state_distrib[state] > 0]
    observed = perform(env, choose_run(table, ending, initial))
    names = [attribute["name"] for attribute in ATTRIBUTES]
    demonstration = [compact(dict(zip(names, states[state]))) for state in observed]

    files = {
        "model.json": model_json(states, table, NAMES),
        "no-west.json": model_json(states, table, [name for name in NAMES if name != "west"]),
        "costly-pickup.json": model_json(states, table, NAMES, {"pickup": 3.0}),
        "demonstration.json": f"[\n{lines(demonstration, 2)}\n]\n",
        "request.json": f'{{\n  "model": "taxi-no-west",\n  "demonstration": [\n{lines(demonstration, 4)}\n  ]\n}}\n',
    }
    out.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        json.loads(text)
        (out / name).write_bytes(text.encode())


if __name__ == "__main__":
    main()
