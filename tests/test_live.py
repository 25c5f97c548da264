"""Watching a training changes nothing of it, and a viewer that is gone does not stop it."""

from __future__ import annotations

from pathlib import Path

import pytest
from rerun.experimental import ViewerClient

from gridnav.display.viewer import ViewerError, address_of, free_port, headless_viewer, wait_until
from gridnav.experiment.live import Spectator, Watch
from gridnav.experiment.results import open_log
from gridnav.experiment.run_directory import RunDirectory
from gridnav.experiment.training import Budget, Choice, Job, Trained, Workshop, unseen
from gridnav.experiment.worlds import Problem

PROBLEM = Problem.load("S...\n.#..\n...G", "default", "default")


def train(path: Path, spectator: Spectator | None) -> Trained:
    with RunDirectory.create(path, "train", {}) as run, open_log(run) as log:
        workshop = Workshop(Job(PROBLEM, Budget(0.2, 2), 0, run, unseen, spectator=spectator), log)
        return workshop.train("q", "q-learning", "GridWorld", choice=Choice(changes={"num_envs": "16", "visits": "50"}))


def test_episodes_arrive_in_the_viewer_and_training_is_the_same(tmp_path: Path) -> None:
    try:
        with headless_viewer((800, 600)) as address:
            watched = train(tmp_path / "watched", Spectator(PROBLEM, address, 0.0))
            client = ViewerClient.connect(address)
            wait_until(lambda: bool(client.get_state().recordings), "take an episode")
            assert client.get_state().recordings
    except ViewerError as error:
        if "Vulkan" in str(error):
            pytest.skip("no Vulkan driver here (Debian package mesa-vulkan-drivers)")
        raise
    alone = train(tmp_path / "alone", None)
    for name, array in alone.agent.state().arrays.items():
        assert (array == watched.agent.state().arrays[name]).all()
    assert (tmp_path / "alone/metrics.jsonl").read_bytes() == (tmp_path / "watched/metrics.jsonl").read_bytes()


def test_who_watches_is_asked_before_the_first_step_and_then_along_the_way(tmp_path: Path) -> None:
    seen: list[int] = []

    class Listed(Spectator):
        def watch(self, name: str, world: str, observation: str) -> Watch:
            return lambda agent, steps: seen.append(steps)

    end = train(tmp_path / "run", Listed(PROBLEM, "rerun+http://127.0.0.1:1/proxy", 0.0)).steps

    assert seen[0] == 0
    assert len(seen) > 2
    assert seen == sorted(seen)
    assert seen[-1] <= end


def test_training_goes_on_without_the_viewer(tmp_path: Path) -> None:
    nobody = f"rerun+http://127.0.0.1:{free_port()}/proxy"
    assert train(tmp_path / "run", Spectator(PROBLEM, nobody, 0.0)).steps > 0


def test_a_port_where_nobody_listens_is_named() -> None:
    port = free_port()
    with pytest.raises(ViewerError, match=f"no viewer listens on port {port}"):
        address_of(port)
