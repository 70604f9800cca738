"""Has Storm build models, write them in its formats, and say through its own interface what is in them.

    storm.py programs OUT              the PRISM programs that come with stormpy
    storm.py explicit OUT STEM         the explicit files STEM.tra, .lab, .srew and .trew, which Storm reads

Of each model, NAME.drn and NAME.umb are written, and NAME.json: names of variables and their values in each state, where the body starts, and each
choice with its ways: next state, probability, and what it earns by each reward.
"""

import json
import sys
from pathlib import Path

import stormpy
from stormpy import io
from stormpy.examples import files

# As the models of the examples are built.
sys.path.insert(0, str(Path(__file__).parents[2] / "examples/verification"))
from make import build

PROGRAMS = """
dtmc/brp-16-2.pm dtmc/crowds-5-5.pm dtmc/die.pm dtmc/leader-3-5.pm dtmc/nand-5-2.pm dtmc/negativevals.pm dtmc/test_conditional.pm
mdp/SmallPrismTest.nm mdp/SmallPrismTest2.nm mdp/coin2-2.nm mdp/csma2-2.nm mdp/die_c1.nm mdp/die_selection.nm mdp/firewire3-0.5.nm mdp/leader3.nm
mdp/leader4.nm mdp/maze_2.nm mdp/maze_2_multigoal.nm mdp/multiobjective1.nm mdp/multiobjective2.nm mdp/scheduler_generation.nm mdp/slipgrid.nm
mdp/tiny_rewards.nm mdp/two_dice.nm mdp/wlan0-2-2.nm pomdp/3x3grid.prism pomdp/maze-concise.prism
"""


def describe(model):
    values = [json.loads(str(model.state_valuations.to_json(state))) for state in range(model.nr_states)] if model.has_state_valuations() else []
    names = list(values[0]) if values else []
    # A row lives only as long as whoever asked for it holds its matrix.
    of_ways = {name: earns.transition_rewards for name, earns in model.reward_models.items() if earns.has_transition_rewards}
    choices = []
    for state in model.states:
        n_called = {}
        for action in state.actions:
            choice = len(choices)
            labels = model.choice_labeling.get_labels_of_choice(choice) if model.has_choice_labeling() else []
            # Choices without a label are numbered from 0, further ones with the same label from 2.
            label = min(labels, default=None)
            n_called[label] = n = n_called.get(label, 0) + 1
            name = str(n - 1) if label is None else label if n == 1 else f"{label} ({n})"
            ways = []
            for way in action.transitions:
                earned = {}
                for reward, earns in model.reward_models.items():
                    of_state = earns.get_state_reward(state.id) if earns.has_state_rewards else 0.0
                    of_choice = earns.get_state_action_reward(choice) if earns.has_state_action_rewards else 0.0
                    row = of_ways[reward].get_row(choice) if reward in of_ways else []
                    of_way = sum(entry.value for entry in row if entry.column == way.column)
                    earned[reward] = of_state + of_choice + of_way
                ways.append([way.column, way.value, earned])
            choices.append([state.id, name, ways])
    return {
        "names": names,
        "states": [[of_state[name] for name in names] for of_state in values],
        "start": list(model.initial_states),
        "rewards": list(model.reward_models),
        "choices": choices,
        "counts": [model.nr_states, model.nr_choices, model.nr_transitions],
    }


def explicit(stem, out):
    """Storm reads PRISM's files with heads of its own."""
    lines = lambda part: stem.with_suffix(part).read_text(encoding="utf-8").splitlines()
    put = lambda part, rows: out.with_suffix(part).write_text("\n".join(rows) + "\n", encoding="utf-8")
    put(".tra", ["mdp", *(" ".join(line.split()[:4]) for line in lines(".tra")[1:])])
    head, *rows = lines(".lab")
    labels = [label.split("=")[1].strip('"') for label in head.split()]
    labelled = [row.split(":") for row in rows]
    put(
        ".lab",
        ["#DECLARATION", " ".join(labels), "#END"]
        + [f"{state} {' '.join(labels[int(number)] for number in numbers.split())}" for state, numbers in labelled],
    )
    for part in (".srew", ".trew"):
        put(part, [line for line in lines(part) if not line.startswith("#")][1:])
    at = lambda part: str(out.with_suffix(part))
    model = stormpy.build_model_from_explicit(
        at(".tra"), at(".lab"), state_rewards=at(".srew"), transition_rewards=at(".trew")
    )
    out.with_suffix(".json").write_text(json.dumps(describe(model)), encoding="utf-8")


def main():
    what, out, *rest = sys.argv[1:]
    out = Path(out)
    if what == "explicit":
        return explicit(Path(rest[0]), out / "explicit")
    for program in PROGRAMS.split():
        model = build(stormpy.parse_prism_program(files._path(*program.split("/"))))
        stem = out / Path(program).stem
        io.export_to_drn(model, f"{stem}.drn")
        io.export_to_umb(model, f"{stem}.umb")
        (out / f"{stem.name}.json").write_text(json.dumps(describe(model)), encoding="utf-8")


if __name__ == "__main__":
    main()
