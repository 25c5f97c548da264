"""Checkpoints: whole or not there, the newest whole one is read, and nothing outside of it."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium.spaces import Discrete

from gridnav.agents import Planner, QLearning, QLearningConfig, read_state, write_state
from gridnav.experiment.checkpoint import KEPT, load_agent, load_checkpoint, save_agent
from gridnav.problem.types import InputError, State


def planner(value: float) -> Planner:
    """An agent that is told apart by its value."""
    return Planner(np.full((3, 4), value))


def loaded_value(directory: Path, name: str = "plan") -> float:
    """The value of the agent that is found."""
    agent = load_agent(directory, name)
    assert isinstance(agent, Planner | QLearning)
    return float(agent.action_values[0, 0])


def edit_manifest(checkpoint: Path, edit: Callable[[dict[str, Any]], object]) -> None:
    manifest = json.loads((checkpoint / "manifest.json").read_text())
    edit(manifest)
    (checkpoint / "manifest.json").write_text(json.dumps(manifest))


def digest(content: bytes) -> dict[str, object]:
    return {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}


# ---- Writing -----------------------------------------------------------------------------------


def test_a_checkpoint_is_a_directory_with_a_hash_of_each_part(tmp_path: Path) -> None:
    checkpoint = save_agent(planner(1.0), tmp_path / "run" / "checkpoints", 12345, name="plan")

    assert checkpoint == tmp_path / "run" / "checkpoints" / "step-000000012345"
    assert {part.name for part in checkpoint.iterdir()} == {"manifest.json", "agent.safetensors", "agent.json"}
    manifest = json.loads((checkpoint / "manifest.json").read_text())
    assert (manifest["format"], manifest["name"], manifest["kind"], manifest["step"]) == (2, "plan", "plan", 12345)
    assert manifest["parts"] == {
        name: digest((checkpoint / name).read_bytes()) for name in ("agent.safetensors", "agent.json")
    }
    assert manifest["versions"].keys() >= {"gridnav", "numpy", "torch", "mujoco"}
    assert manifest["standing"] == {
        "steps": 12345, "seconds": 0.0, "run_steps": 12345, "log_bytes": 0, "is_finished": True,
    }  # fmt: skip


def test_nothing_in_a_checkpoint_is_a_pickle(tmp_path: Path) -> None:
    checkpoint = save_agent(planner(1.0), tmp_path, 1, name="plan")

    for part in checkpoint.iterdir():
        assert part.suffix in {".json", ".safetensors"}
        assert not part.read_bytes().startswith((b"\x80", b"PK")), f"{part.name} looks like a pickle or its archive"


def test_what_is_saved_comes_back(tmp_path: Path) -> None:
    learner = QLearning(Discrete(5), Discrete(4), QLearningConfig(seed=4))
    learner.action_values = np.random.default_rng(0).normal(size=(5, 4))
    save_agent(learner, tmp_path, 7, name="q")

    agent = load_agent(tmp_path, "q")

    assert isinstance(agent, QLearning)
    assert agent.action_values.tobytes() == learner.action_values.tobytes()
    assert agent.config == learner.config


def test_the_newest_of_each_name_is_read(tmp_path: Path) -> None:
    for step, name, value in ((1, "plan", 1.0), (2, "other", 2.0), (9, "plan", 9.0), (10, "plan", 10.0)):
        save_agent(planner(value), tmp_path, step, name=name)

    assert loaded_value(tmp_path, "plan") == 10.0
    assert loaded_value(tmp_path, "other") == 2.0
    with pytest.raises(InputError, match="no checkpoint of 'third'"):
        load_agent(tmp_path, "third")


def test_old_checkpoints_of_the_same_name_are_pruned(tmp_path: Path) -> None:
    save_agent(planner(0.0), tmp_path, 1, name="other")
    for step in range(2, 7):
        save_agent(planner(step), tmp_path, step, name="plan")

    assert KEPT == 2
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"step-{step:012d}" for step in (1, 5, 6)]


def test_a_second_checkpoint_of_the_same_step_takes_the_next_name_and_counts_as_newer(tmp_path: Path) -> None:
    """A run that is interrupted before its second agent took a step must not lose the first one."""
    save_agent(planner(1.0), tmp_path, 5, name="plan")
    save_agent(planner(2.0), tmp_path, 5, name="plan")

    assert loaded_value(tmp_path) == 2.0
    assert {path.name for path in tmp_path.iterdir()} == {"step-000000000005", "step-000000000006"}


def test_what_is_saved_later_counts_as_newer_whatever_pruning_has_freed(tmp_path: Path) -> None:
    """Several checkpoints between two reports have one step number: the third frees the first one's name."""
    for value in range(5):
        save_agent(planner(value), tmp_path, 7, name="plan")
        assert loaded_value(tmp_path) == value

    # By hand: numbers 7 to 11, of which the last two are kept.
    assert sorted(path.name for path in tmp_path.iterdir()) == ["step-000000000010", "step-000000000011"]


def test_damaged_checkpoints_of_another_agent_are_none_of_ones_business(tmp_path: Path) -> None:
    flip(save_agent(planner(1.0), tmp_path, 1, name="first") / "agent.json")

    assert load_checkpoint(tmp_path, "second") is None
    with pytest.raises(InputError, match="holds no whole checkpoint of 'first'"):
        load_checkpoint(tmp_path, "first")


def test_one_number_comes_back_as_one_number_and_not_as_a_list(tmp_path: Path) -> None:
    write_state(State({"step": np.array(7.0), "row": np.zeros((0, 3))}, {}), tmp_path, "part")

    arrays = read_state(tmp_path, "part").arrays

    assert arrays["step"].shape == ()
    assert arrays["row"].shape == (0, 3)


@pytest.mark.parametrize("broken", ["rename", "fsync"])
def test_a_write_that_is_cut_short_leaves_the_last_whole_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, broken: str
) -> None:
    save_agent(planner(1.0), tmp_path, 1, name="plan")

    def fail(*_: object) -> None:
        raise OSError("disk full")

    with monkeypatch.context() as patch:
        patch.setattr(*((Path, "rename") if broken == "rename" else (os, "fsync")), fail)
        with pytest.raises(OSError, match="disk full"):
            save_agent(planner(2.0), tmp_path, 2, name="plan")

    assert loaded_value(tmp_path) == 1.0
    assert [path.name for path in tmp_path.glob("step-*")] == ["step-000000000001"]
    save_agent(planner(3.0), tmp_path, 3, name="plan")
    assert loaded_value(tmp_path) == 3.0


# ---- Reading -----------------------------------------------------------------------------------


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1])


def flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(bytes(content))


DAMAGES: dict[str, Callable[[Path], object]] = {
    "weights cut short": lambda c: truncate(c / "agent.safetensors"),
    "one bit of the weights": lambda c: flip(c / "agent.safetensors"),
    "one bit of the agent": lambda c: flip(c / "agent.json"),
    "no weights": lambda c: (c / "agent.safetensors").unlink(),
    "no manifest": lambda c: (c / "manifest.json").unlink(),
    "manifest cut short": lambda c: truncate(c / "manifest.json"),
    "empty manifest": lambda c: (c / "manifest.json").write_bytes(b""),
    "binary manifest": lambda c: (c / "manifest.json").write_bytes(bytes(range(128, 256))),
    "manifest of another shape": lambda c: (c / "manifest.json").write_text("[1, 2]"),
    "bottomless manifest": lambda c: (c / "manifest.json").write_text("[" * 100_000),
    "another format": lambda c: edit_manifest(c, lambda m: m.update(format=1)),
    "no name": lambda c: edit_manifest(c, lambda m: m.pop("name")),
    "no kind": lambda c: edit_manifest(c, lambda m: m.pop("kind")),
    "no parts": lambda c: edit_manifest(c, lambda m: m.update(parts={})),
    "parts of another shape": lambda c: edit_manifest(c, lambda m: m.update(parts=["agent.safetensors"])),
    "another hash": lambda c: edit_manifest(c, lambda m: m["parts"]["agent.json"].update(sha256="0" * 64)),
    "another size": lambda c: edit_manifest(c, lambda m: m["parts"]["agent.json"].update(bytes=1)),
    "a part that is not there": lambda c: edit_manifest(c, lambda m: m["parts"].update(more=digest(b""))),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_checkpoint_is_passed_over_for_the_one_before(tmp_path: Path, damage: str) -> None:
    save_agent(planner(1.0), tmp_path, 1, name="plan")
    DAMAGES[damage](save_agent(planner(2.0), tmp_path, 2, name="plan"))

    assert loaded_value(tmp_path) == 1.0


@pytest.mark.parametrize("name", ["../outside.txt", "{outside}", "sub/../../outside.txt", "..", "", "nul\0"])
def test_a_manifest_cannot_point_outside_its_directory(tmp_path: Path, name: str) -> None:
    outside = tmp_path / "outside.txt"
    outside.write_text("secret")
    save_agent(planner(1.0), tmp_path, 1, name="plan")
    newest = save_agent(planner(2.0), tmp_path, 2, name="plan")
    part = name.format(outside=outside)
    # The hash is right, so that it is for its path alone that it is refused.
    edit_manifest(newest, lambda manifest: manifest["parts"].update({part: digest(b"secret")}))

    assert loaded_value(tmp_path) == 1.0


def test_what_a_killed_run_leaves_behind_is_not_read(tmp_path: Path) -> None:
    save_agent(planner(1.0), tmp_path, 1, name="plan")
    aside = save_agent(planner(2.0), tmp_path, 2, name="plan")
    aside.rename(tmp_path / ".tmp-0123")
    (tmp_path / "step-000000000009").mkdir()
    (tmp_path / "step-000000000008").write_text("a file")

    assert loaded_value(tmp_path) == 1.0


@pytest.mark.parametrize("missing", [True, False])
def test_no_checkpoint_at_all_is_said_in_one_line(tmp_path: Path, missing: bool) -> None:
    directory = tmp_path / "none" if missing else tmp_path

    with pytest.raises(InputError, match="holds no checkpoint of 'plan'") as caught:
        load_agent(directory, "plan")

    assert str(caught.value).isprintable()


def test_an_unknown_kind_of_agent_is_named(tmp_path: Path) -> None:
    newest = save_agent(planner(1.0), tmp_path, 1, name="plan")
    edit_manifest(newest, lambda manifest: manifest.update(kind="oracle"))

    with pytest.raises(InputError, match="unknown kind 'oracle'"):
        load_agent(tmp_path, "plan")
