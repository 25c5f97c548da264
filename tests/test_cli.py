"""The command line: exit codes, one-line errors, nothing written on bad input."""

import json
from pathlib import Path

import pytest

from gridnav.cli import main

UNREACHABLE = ".#.\n###\n..."


@pytest.fixture
def in_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(*words: str) -> int:
    with pytest.raises(SystemExit) as leaving:
        main(words)
    return int(leaving.value.code or 0)


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["fly"], "fly"),
        (["ladder", "--layout", "no-such-maze"], "no-such-maze"),
        (["train", "--layout", "..\n.x"], "line 2, column 2"),
        (["train", "--layout", UNREACHABLE], "cannot be reached"),
        (["train", "--task", "no-such-task"], "no-such-task"),
        (["train", "--reward", "no-such-reward"], "no-such-reward"),
        (["train", "--agent", "oracle"], "oracle"),
        (["train", "--agent", "ppo", "--env", "gridnav/GridWorld-v0"], "gridnav/GridWorld-v0"),
        (["train", "--agent", "q-learning", "--env", "gridnav/DiffDrive-v0"], "gridnav/DiffDrive-v0"),
        (["train", "--env", "CartPole-v1"], "CartPole-v1"),
        (["train", "--sed", "1"], "--sed"),
        (["train", "--seed", "one"], "one"),
        (["train", "--budget", "huge"], "huge"),
        (["train", "--seed", "-1"], "-1"),
        (["train", "--config", "missing.json"], "missing.json"),
        (["train", "--config=missing.json"], "missing.json"),
        (["train", "--config"], "--config"),
        (["view"], "view"),
        (["view", "no-such-run"], "no-such-run"),
        (["evaluate", "no-such-run"], "no-such-run"),
        (["layout", "check", "..\n."], "line 2"),
        (["layout", "draw", "--output", "missing/maze.txt"], "missing"),
        (["layout", "generate", "maze", "--rows", "4"], "4 x 11"),
        (["layout", "generate", "spiral"], "spiral"),
        (["layout", "generate", "random", "--density", "2"], "2.0"),
        (["lint-reward", "--gamma", "1.5"], "1.5"),
        (["lint-reward", "--gamma", "1"], "1.0"),
        (["lint-reward", "--time-cost", "nan"], "nan"),
    ],
)
def test_bad_input_gets_one_line_that_names_it_and_writes_nothing(
    words: list[str], named: str, in_empty_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(*words) == 2

    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("gridnav: ")
    assert named in line
    assert len(line) < 300
    assert list(in_empty_folder.iterdir()) == []


@pytest.mark.parametrize("content", ["{", "[1]", '{"command": "ladder"}', '{"command": "train", "sed": 1}'])
def test_a_wrong_config_file_is_refused(
    content: str, in_empty_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("config.json").write_text(content, encoding="utf-8")

    assert run("train", "--config", "config.json") == 2

    assert len(capsys.readouterr().err.splitlines()) == 1
    assert [path.name for path in in_empty_folder.iterdir()] == ["config.json"]


def test_a_run_directory_in_use_is_never_overwritten(in_empty_folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path("mine").mkdir()
    Path("mine/thesis.txt").write_text("years of work", encoding="utf-8")

    assert run("train", "--run-dir", "mine") == 2

    assert "mine" in capsys.readouterr().err
    assert [path.name for path in Path("mine").iterdir()] == ["thesis.txt"]


def test_an_unwritable_place_is_an_error_of_the_environment(
    in_empty_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("file").write_text("", encoding="utf-8")

    assert run("train", "--run-dir", "file/run") == 3

    assert len(capsys.readouterr().err.splitlines()) == 1


def test_a_drawn_layout_reads_back(in_empty_folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("layout", "generate", "maze", "--seed", "3", "--output", "maze.txt") == 0
    assert run("layout", "draw", "maze.txt") == 0

    assert capsys.readouterr().out == Path("maze.txt").read_text(encoding="utf-8")
    assert run("layout", "check", "maze.txt") == 0


def test_the_lint_fails_on_a_reward_under_which_idling_pays(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("lint-reward", "--time-cost", "0") == 1

    assert "FAIL all worlds: standing still" in capsys.readouterr().out


def test_a_trained_run_holds_what_the_contract_says_and_its_config_makes_it_again(
    in_empty_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("train", "--agent", "q-learning", "--budget", "quick", "--seed", "3", "--run-dir", "first") == 0
    names = {path.name for path in Path("first").iterdir()}
    assert names >= {"config.json", "metrics.jsonl", "evaluation.json", "report.html", "rollout.rrd"}
    assert any(name.startswith("events.out.tfevents.") for name in names)
    assert list(Path("first/figures").glob("*.png"))
    assert list(Path("first/checkpoints").glob("step-*/manifest.json"))

    assert run("train", "--config", "first/config.json", "--run-dir", "second") == 0
    for name in ("config.json", "metrics.jsonl"):
        assert (Path("first") / name).read_text() == (Path("second") / name).read_text()
    first, second = (json.loads((Path(run_dir) / "evaluation.json").read_text()) for run_dir in ("first", "second"))
    for evaluation in (first, second):
        assert evaluation["results"]["q-learning"].pop("training_seconds") > 0
    assert first == second

    capsys.readouterr()
    assert run("evaluate", "first", "--episodes", "20", "--output", "again.json") == 0
    again = json.loads(Path("again.json").read_text())
    assert again["results"]["q-learning"]["success_rate"] == 1.0


def test_debug_shows_the_traceback_and_keeps_the_exit_code(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("train", "--layout", "no-such-maze", "--debug") == 2

    assert "InputError: unknown layout" in capsys.readouterr().err


def test_a_damaged_run_is_refused(in_empty_folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path("run").mkdir()
    Path("run/config.json").write_text('{"layout": "classic"}', encoding="utf-8")
    Path("run/evaluation.json").write_text("{}", encoding="utf-8")

    assert run("evaluate", "run") == 2

    assert "no whole run" in capsys.readouterr().err
