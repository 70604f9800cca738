# /// script
# requires-python = ">=3.10"
# dependencies = ["stormpy==2.0.0"]
# ///
"""Writes what Storm and PRISM make of corridor.prism, for `etude model import`.

    python make.py [--out DIR]        (or: uv run make.py)

    corridor.drn  slippery.drn       Storm's explicit format; slippery is with `slip` 0.1, where an action has several outcomes
    corridor.umb  slippery.umb       the common format of Storm, PRISM and Modest
    slippery.tra  .sta .lab .srew .trew   PRISM's explicit files, of the reward "energy"
    corridor.json slippery.json      what Storm's own interface says of the states and choices, to compare with

PRISM's files are written here, as its manual says, from what Storm has built; the others by Storm itself.
"""

import argparse
import json
from pathlib import Path

import stormpy
from stormpy import io

HERE = Path(__file__).parent
VARIABLES = ["x", "lane", "open"]


def corridor(slip):
    program = stormpy.parse_prism_program(str(HERE / "corridor.prism"))
    program, _ = io.instantiate_constants(program, {"slip": slip})
    return build(program)


def build(program):
    """The model of a program, with all that can be told of it."""
    options = stormpy.BuilderOptions()
    options.set_build_state_valuations()
    options.set_build_choice_labels()
    options.set_build_all_labels()
    options.set_build_all_reward_models()
    return stormpy.build_model(program, options=options)


def describe(model):
    """The states, each with its choices, as the interface of Storm gives them."""
    rewards = model.reward_models
    states = []
    for state in model.states:
        values = json.loads(str(model.state_valuations.to_json(state.id)))
        choices = []
        for action in state.actions:
            choice = model.get_choice_index(state.id, action.id)
            labels = sorted(model.choice_labeling.get_labels_of_choice(choice))
            earned = {}
            for name, reward in rewards.items():
                of_state = reward.get_state_reward(state.id) if reward.has_state_rewards else 0.0
                of_choice = reward.get_state_action_reward(choice) if reward.has_state_action_rewards else 0.0
                earned[name] = [of_state, of_choice]
            ways = [[way.column, way.value] for way in action.transitions]
            choices.append({"label": labels[0] if labels else None, "rewards": earned, "ways": ways})
        labels = sorted(state.labels)
        states.append({"values": [values[name] for name in VARIABLES], "labels": labels, "choices": choices})
    return {"variables": VARIABLES, "states": states}


def write_prism(described, reward, stem):
    states = described["states"]
    value = lambda v: str(v).lower() if isinstance(v, bool) else str(v)
    rows = [f"{n}:({','.join(map(value, state['values']))})" for n, state in enumerate(states)]
    stem.with_suffix(".sta").write_text(f"({','.join(described['variables'])})\n" + "\n".join(rows) + "\n")

    names = ["init", "deadlock", *sorted({label for state in states for label in state["labels"]} - {"init", "deadlock"})]
    header = " ".join(f'{n}="{name}"' for n, name in enumerate(names))
    rows = [f"{n}: {' '.join(str(names.index(l)) for l in s['labels'])}" for n, s in enumerate(states) if s["labels"]]
    stem.with_suffix(".lab").write_text(header + "\n" + "\n".join(rows) + "\n")

    choices = [(s, c, choice) for s, state in enumerate(states) for c, choice in enumerate(state["choices"])]
    ways = [f"{s} {c} {to} {p!r}{' ' + choice['label'] if choice['label'] else ''}" for s, c, choice in choices for to, p in choice["ways"]]
    stem.with_suffix(".tra").write_text(f"{len(states)} {len(choices)} {len(ways)}\n" + "\n".join(ways) + "\n")

    earned = [(n, state["choices"][0]["rewards"][reward][0]) for n, state in enumerate(states)]
    rows = [f"{n} {r!r}" for n, r in earned if r]
    header = f'# Reward structure: "{reward}"\n# State rewards\n'
    stem.with_suffix(".srew").write_text(header + f"{len(states)} {len(rows)}\n" + "\n".join(rows) + "\n")
    rows = [f"{s} {c} {to} {choice['rewards'][reward][1]!r}" for s, c, choice in choices for to, _ in choice["ways"] if choice["rewards"][reward][1]]
    header = f'# Reward structure: "{reward}"\n# Transition rewards\n'
    stem.with_suffix(".trew").write_text(header + f"{len(states)} {len(choices)} {len(rows)}\n" + "\n".join(rows) + "\n")


def main():
    parser = argparse.ArgumentParser(description="Write what Storm and PRISM make of corridor.prism.")
    parser.add_argument("--out", metavar="DIR", type=Path, default=HERE, help="default: beside this script")
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    for name, slip in {"corridor": 0.0, "slippery": 0.1}.items():
        model = corridor(slip)
        io.export_to_drn(model, str(out / f"{name}.drn"))
        io.export_to_umb(model, str(out / f"{name}.umb"))
        described = describe(model)
        lines = ",\n".join("  " + json.dumps(state) for state in described["states"])
        (out / f"{name}.json").write_text(f'{{"variables": {json.dumps(VARIABLES)}, "states": [\n{lines}\n]}}\n')
        if name == "slippery":
            write_prism(described, "energy", out / name)


if __name__ == "__main__":
    main()
