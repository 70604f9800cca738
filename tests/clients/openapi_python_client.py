"""Uses the client that openapi-python-client has made, the package `made_by_openapi_python_client`, against the service at argv[1]."""

import sys

from made_by_openapi_python_client import Client
from made_by_openapi_python_client.api.learners import put_learner
from made_by_openapi_python_client.api.models import get_model, put_model
from made_by_openapi_python_client.api.policies import make_policy
from made_by_openapi_python_client.api.trials import make_trial, put_reward
from made_by_openapi_python_client.models import (
    Action,
    Attribute,
    KindName,
    LearnerDefinition,
    ModelDefinition,
    ObservationType0,
    PolicyRequest,
    PolicyRequestWeightsType0,
    Problem,
    Reward,
    TableDynamics,
    TableDynamicsKind,
    TrialRequest,
)

client = Client(base_url=sys.argv[1])


def observed(**values):
    return ObservationType0.from_dict(values)


body = ModelDefinition(
    attributes=[
        Attribute(name="x", kind=KindName.NUMBER),
        Attribute(name="heading", kind=KindName.CYCLIC, labels=["east", "north", "west", "south"]),
        Attribute(name="door", kind=KindName.CATEGORY, weight=0.5),
    ],
    actions=[Action(name="forward", cost=0.25), Action(name="push")],
    dynamics=TableDynamics(
        kind=TableDynamicsKind.TABLE,
        states=[[0, "east", False], [1, "east", False], [1, "east", True], [2.5, "east", True]],
        transitions=[[0, "forward", 1], [1, 1, 2], [2, "forward", 3, 1, 0.75]],
        start=0,
    ),
)
registered = put_model.sync(model="made", client=client, body=body)
assert registered.counts.states == 4, registered
whole = get_model.sync(model="made", client=client)
assert whole.definition.dynamics.transitions[2] == [2, "forward", 3, 1, 0.75], whole

demonstration = [observed(x=0, door=False), observed(x=1, door=True), [2.5, "east", None]]
policy = make_policy.sync(
    client=client,
    body=PolicyRequest(
        model="made", demonstration=demonstration, weights=PolicyRequestWeightsType0.from_dict({"door": 3})
    ),
)
assert policy.actions == ["forward", "push", "forward"], policy
assert policy.steps[-1].state["x"] == 2.5 and policy.cost.distance == 1, policy

refused = make_policy.sync(client=client, body=PolicyRequest(model="made", demonstration=[observed(y=1)]))
assert isinstance(refused, Problem) and refused.errors[0].pointer == "/demonstration/0/y", refused

put_learner.sync(learner="made", client=client, body=LearnerDefinition(attributes=["x", "door"], seed=3))
trial = make_trial.sync(
    learner="made", client=client, body=TrialRequest(model="made", demonstration=demonstration)
)
assert trial.policy.actions and trial.reward is None, trial
rewarded = put_reward.sync(trial=trial.id, client=client, body=Reward(reward=974))
assert (rewarded.id, rewarded.reward, rewarded.reward_order) == (trial.id, 974, 1), rewarded
