"""From words to hyper-parameters: types, ranges, and errors that help."""

from __future__ import annotations

from typing import Any

import pytest
from gridnav.agents.ppo import POSE

from gridnav.envs import FeatureVector
from gridnav.experiment.presets import choose_config, presets
from gridnav.problem.layout import Layout
from gridnav.problem.robot import BURGER
from gridnav.problem.types import InputError


@pytest.mark.parametrize(
    ("kind", "name", "words", "value"),
    [
        ("q-learning", "visits", "7", 7),
        ("q-learning", "learning_rate", "0.25", 0.25),
        ("q-learning", "learning_rate", "1", 1),
        ("q-learning", "learning_rate", "5e-1", 0.5),
        ("q-learning", "exploring_starts", "false", False),
        ("q-learning", "epsilon_decay", "null", None),
        ("q-learning", "epsilon_decay", "0.5", 0.5),
        ("q-learning", "episodes", "12", 12),
        ("dqn", "loss", "mse", "mse"),
        ("dqn", "loss", '"mse"', "mse"),
        ("dqn", "double", "true", True),
        ("dqn", "hidden", "[16]", (16,)),
        ("dqn", "hidden", "[16, 8]", (16, 8)),
        ("ppo", "ignored", "[]", ()),
        ("ppo", "target_success", "null", None),
        ("ppo", "log_std_init", "-2", -2),
    ],
)
def test_words_become_values_of_the_fields_type(kind: str, name: str, words: str, value: Any) -> None:
    config = choose_config(kind, "default", {name: words})

    assert getattr(config, name) == value
    assert type(getattr(config, name)) is type(value)
    assert presets(kind)["default"] != config or value == getattr(presets(kind)["default"], name)


@pytest.mark.parametrize(
    ("kind", "name", "words"),
    [
        ("q-learning", "visits", "7.5"),
        ("q-learning", "visits", "true"),  # Python's True is a 1
        ("q-learning", "visits", "seven"),
        ("q-learning", "visits", ""),
        ("q-learning", "visits", "null"),
        ("q-learning", "visits", "9" * 5_000),  # more digits than Python reads
        ("q-learning", "learning_rate", "true"),
        ("q-learning", "learning_rate", "NaN"),
        ("q-learning", "learning_rate", "Infinity"),
        ("q-learning", "exploring_starts", "1"),
        ("q-learning", "exploring_starts", "yes"),
        ("dqn", "hidden", "16"),
        ("dqn", "hidden", "[16.5]"),
        ("dqn", "hidden", "[true]"),
        ("dqn", "hidden", "[[16]]"),
        ("dqn", "hidden", "[" * 50_000),
        ("dqn", "loss", "l1"),
        ("dqn", "loss", "[]"),
        ("dqn", "loss", "{}"),
    ],
)
def test_values_of_another_type_are_refused_in_one_line(kind: str, name: str, words: str) -> None:
    with pytest.raises(InputError, match=f"^{name}=.* is not of type") as caught:
        choose_config(kind, "default", {name: words})

    assert str(caught.value).isprintable()
    assert len(str(caught.value)) <= 200


@pytest.mark.parametrize(
    ("kind", "name", "words"),
    [
        ("q-learning", "visits", "0"),
        ("q-learning", "num_envs", "-1"),
        ("q-learning", "learning_rate", "0"),
        ("q-learning", "learning_rate", "1e999"),
        ("q-learning", "gamma", "1.5"),
        ("q-learning", "gamma", "-0.1"),
        ("q-learning", "epsilon_start", "2"),
        ("q-learning", "epsilon_decay", "-1"),
        ("q-learning", "episodes", "0"),
        ("q-learning", "num_envs", "1" + "0" * 400),
        ("dqn", "warm_up", "-1"),
        ("dqn", "hidden", "[]"),
        ("dqn", "hidden", "[0]"),
        ("ppo", "ent_coef", "-1"),
        ("ppo", "gae_lambda", "1.01"),
        ("ppo", "target_success", "2"),
        ("ppo", "log_std_init", "1e999"),
        ("ppo", "hidden", "[0]"),
        ("ppo", "hidden", "[16, -3]"),
        ("ppo", "ignored", "[-1]"),
        ("ppo", "batch_size", "1"),
    ],
)
def test_values_outside_their_range_are_refused_by_name(kind: str, name: str, words: str) -> None:
    with pytest.raises(InputError, match=rf"^{name} .* must be"):
        choose_config(kind, "default", {name: words})


@pytest.mark.parametrize(
    ("kind", "name", "near"),
    [("q-learning", "learning_rat", "learning_rate"), ("dqn", "targets_every", "target_every"), ("ppo", "epoch", "")],
)
def test_an_unknown_name_is_answered_with_the_nearest(kind: str, name: str, near: str) -> None:
    with pytest.raises(InputError, match=rf"^{kind} has no hyper-parameter '{name}': did you mean {near}"):
        choose_config(kind, "default", {name: "1"})


@pytest.mark.parametrize("kind", ["q-learning", "dqn", "ppo"])
def test_an_unknown_preset_is_answered_with_those_there_are(kind: str) -> None:
    with pytest.raises(InputError, match=f"unknown preset 'no-such' of {kind}: the presets are default"):
        choose_config(kind, "no-such", {})


def test_changes_leave_the_preset_as_it_is() -> None:
    before = presets("dqn")["tutorial"]

    config = choose_config("dqn", "tutorial", {"double": "true"})

    assert config.double
    assert config.episodes == before.episodes == 500
    assert presets("dqn")["tutorial"] is before
    assert not before.double


def test_the_planner_has_no_hyper_parameters() -> None:
    assert presets("plan") == {}


def test_the_pose_that_networks_may_ignore_is_where_the_robots_hold_it() -> None:
    slices = FeatureVector(Layout.load("classic"), BURGER).slices

    assert (*range(35)[slices["position"]], *range(35)[slices["heading"]]) == POSE
