"""Uses the client that openapi-generator has made, the package `made_by_openapi_generator`, against the service at argv[1]."""

import sys

import made_by_openapi_generator as made
from made_by_openapi_generator import exceptions

client = made.ApiClient(made.Configuration(host=sys.argv[1]))
models, policies = made.ModelsApi(client), made.PoliciesApi(client)
learners, trials = made.LearnersApi(client), made.TrialsApi(client)


def value(value):
    return made.Scalar(value)


def observed(**values):
    return made.Observation({name: made.Observed(seen) for name, seen in values.items()})


def transition(*parts):
    return [made.TransitionEntryInner(part) for part in parts]


body = made.ModelDefinition(
    attributes=[
        made.Attribute(name="x", kind="number"),
        made.Attribute(name="heading", kind="cyclic", labels=["east", "north", "west", "south"]),
        made.Attribute(name="door", kind="category", weight=0.5),
    ],
    actions=[made.Action(name="forward", cost=0.25), made.Action(name="push")],
    dynamics=made.Dynamics(
        made.TableDynamics(
            kind="table",
            states=[
                [value(x), value("east"), value(is_open)]
                for x, is_open in [(0, False), (1, False), (1, True), (2.5, True)]
            ],
            transitions=[
                transition(0, "forward", 1),
                transition(1, 1, 2),
                transition(2, "forward", 3, 1, 0.75),
            ],
            start=made.StartStates(0),
        )
    ),
)
registered = models.put_model("other", body)
assert registered.counts.states == 4, registered
whole = models.get_model("other")
assert whole.definition.dynamics.actual_instance.transitions[2][4].actual_instance == 0.75, whole

demonstration = [
    observed(x=0, door=False),
    observed(x=1, door=True),
    made.Observation([made.Observed(2.5), made.Observed("east"), made.Observed(None)]),
]
policy = policies.make_policy(
    made.PolicyRequest(model="other", demonstration=demonstration, weights={"door": 3})
)
assert policy.actions == ["forward", "push", "forward"], policy
assert policy.steps[-1].state["x"].actual_instance == 2.5 and policy.cost.distance == 1, policy

try:
    policies.make_policy(made.PolicyRequest(model="other", demonstration=[observed(y=1)]))
    raise AssertionError("an unknown attribute is refused")
except exceptions.UnprocessableEntityException as refused:
    assert refused.data.errors[0].pointer == "/demonstration/0/y", refused

learners.put_learner("other", made.LearnerDefinition(attributes=["x", "door"], seed=3))
trial = trials.make_trial("other", made.TrialRequest(model="made", demonstration=demonstration))
assert trial.policy.actions and trial.reward is None, trial
rewarded = trials.put_reward(trial.id, made.Reward(reward=974))
assert (rewarded.id, rewarded.reward, rewarded.reward_order) == (trial.id, 974, 1), rewarded
