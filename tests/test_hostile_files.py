"""Files that are damaged or made to harm: refused in one line, nothing written, and nothing in them is ever run."""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import pickle
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import run_cli
from safetensors.numpy import load_file, save_file

from gridnav.experiment.checkpoint import load_checkpoint

WORDS = ["train", "--layout", "S..\n.#.\n..G", "--budget", "quick", "--checkpoint-s", "0"]
SMALL = {"q-learning": ["num_envs=4", "visits=8"], "ppo": ["num_envs=8", "n_steps=8", "batch_size=32", "steps=1000"]}


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run with two checkpoints: the last cut of its training, and the trained agent."""
    run = tmp_path_factory.mktemp("good") / "run"
    with contextlib.redirect_stderr(io.StringIO()), contextlib.redirect_stdout(io.StringIO()):
        assert run_cli(*WORDS, "--run-dir", str(run), "--set", *SMALL["q-learning"]) == 0
    return run


@pytest.fixture
def run(good: Path, tmp_path: Path) -> Path:
    """A copy, to be damaged."""
    return Path(shutil.copytree(good, tmp_path / "run"))


def checkpoints(run: Path) -> list[Path]:
    return sorted((run / "checkpoints").glob("step-*"))


def cut_only(run: Path) -> Path:
    """Leave the checkpoint of the unfinished training alone."""
    cut, finished = checkpoints(run)
    shutil.rmtree(finished)
    return cut


def contents(directory: Path) -> dict[str, bytes]:
    """Every file, but for those that say who owns the run."""
    files = (path for path in directory.rglob("*") if path.is_file() and path.name not in (".lock", ".owner"))
    return {str(path.relative_to(directory)): path.read_bytes() for path in files}


def one_line(capsys: pytest.CaptureFixture[str]) -> str:
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("gridnav: ")
    assert len(line) <= 300, line
    return line


def digest(content: bytes) -> dict[str, object]:
    return {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}


def edit(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change a JSON file; a part of a checkpoint gets its right hash."""
    content = json.loads(path.read_text())
    change(content)
    replace(path, json.dumps(content).encode())


def edit_arrays(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    arrays = load_file(path)
    change(arrays)
    save_file(arrays, path)
    replace(path, path.read_bytes())


def replace(path: Path, content: bytes) -> None:
    """Put other content in the place of a file; a part of a checkpoint gets its right hash."""
    path.write_bytes(content)
    manifest = path.parent / "manifest.json"
    if path != manifest and manifest.is_file():
        told = json.loads(manifest.read_text())
        told["parts"][path.name] = digest(content)
        manifest.write_text(json.dumps(told))


# ---- Damaged checkpoints -----------------------------------------------------------------------


def flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 4
    path.write_bytes(bytes(content))


def halve(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def link(path: Path) -> None:
    """The same content, through a link out of the checkpoint."""
    aside = path.parents[3] / "aside"
    path.rename(aside)
    path.symlink_to(aside)


PARTS = [f"{part}.{end}" for part in ("agent", "training", "worlds", "visits") for end in ("json", "safetensors")]
DAMAGES: dict[str, tuple[str, Callable[[Path], object]]] = {
    **{f"a bit of {part} flipped": (part, flip) for part in PARTS},
    **{f"{part} cut in half": (part, halve) for part in PARTS},
    **{f"{part} missing": (part, Path.unlink) for part in PARTS},
    **{f"{part} a link": (part, link) for part in ("agent.safetensors", "training.json", "manifest.json")},
    "manifest cut in half": ("manifest.json", halve),
    "manifest missing": ("manifest.json", Path.unlink),
    "manifest of another format": ("manifest.json", lambda p: edit(p, lambda m: m.update(format=1))),
    "manifest with a path": (
        "manifest.json", lambda p: edit(p, lambda m: m["parts"].update({"../../config.json": digest(b"")})),
    ),
    "manifest with a number that is none": (
        "manifest.json", lambda p: p.write_text(p.read_text().replace('"seconds": ', '"seconds": NaN, "x": ')),
    ),
    "manifest with a key twice": (
        "manifest.json", lambda p: p.write_text(p.read_text().replace("{", '{"name": "x", ', 1)),
    ),
    "manifest without a bottom": ("manifest.json", lambda p: p.write_text('{"a":' * 100_000)),
    "manifest with a negative length": (
        "manifest.json", lambda p: edit(p, lambda m: m["standing"].update(log_bytes=-1)),
    ),
    "manifest with a length in words": (
        "manifest.json", lambda p: edit(p, lambda m: m["standing"].update(log_bytes="all")),
    ),
    "manifest with an unknown key": ("manifest.json", lambda p: edit(p, lambda m: m["standing"].update(more=1))),
    "manifest without half of a pair": (
        "manifest.json", lambda p: edit(p, lambda m: m["parts"].pop("training.safetensors")),
    ),
}  # fmt: skip


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_run_whose_only_checkpoint_is_damaged_is_refused_and_left_as_it_is(
    damage: str, run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cut = cut_only(run)
    part, act = DAMAGES[damage]
    act(cut / part)
    before = contents(run)

    for command in (["evaluate", str(run)], ["train", "--resume", "--run-dir", str(run)]):
        assert run_cli(*command) == 2
        assert f"{cut.name}/" in (line := one_line(capsys)) or f"{cut.name} " in line
        assert contents(run) == before


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_checkpoint_is_passed_over_for_the_one_before_with_a_word(
    damage: str, run: Path, caplog: pytest.LogCaptureFixture
) -> None:
    cut = cut_only(run)
    older = run / "checkpoints" / "step-000000000000"
    shutil.copytree(cut, older)
    part, act = DAMAGES[damage]
    act(cut / part)
    before = contents(run)

    found = load_checkpoint(run / "checkpoints", "q-learning")

    assert found is not None
    assert found.training is not None
    (told,) = caplog.records
    assert told.levelname == "WARNING"
    assert "going back to step-000000000000" in told.getMessage()
    assert told.getMessage().isprintable()
    assert contents(run) == before


# ---- Whole checkpoints that hold something else ------------------------------------------------

Change = Callable[[dict[str, Any]], object]
WRONG: dict[str, tuple[str, Change]] = {
    "an agent of another kind": ("agent.json", lambda v: v.update(kind="plan")),
    "an agent of no kind": ("agent.json", lambda v: v.pop("kind")),
    "an unknown hyper-parameter": ("agent.json", lambda v: v["config"].update(more=1)),
    "a hyper-parameter out of range": ("agent.json", lambda v: v["config"].update(gamma=2.0)),
    "no hyper-parameters": ("agent.json", lambda v: v.pop("config")),
    "a list for hyper-parameters": ("agent.json", lambda v: v.update(config=[1])),
    "no table": ("agent.safetensors", lambda a: a.update(other=a.pop("action_values"))),
    "a table of one axis": ("agent.safetensors", lambda a: a.update(action_values=np.zeros(7))),
    "a table with NaN": ("agent.safetensors", lambda a: a["action_values"].fill(np.nan)),
}
WRONG_TRAINING: dict[str, tuple[str, Change]] = {
    "no batch": ("training.json", lambda v: v.pop("batch")),
    "a batch in words": ("training.json", lambda v: v.update(batch="x")),
    "no window": ("training.json", lambda v: v.update(window={})),
    "no stream": ("training.json", lambda v: v.pop("rng")),
    "a stream of another kind": ("training.json", lambda v: v["rng"].update(bit_generator="MT19937")),
    "no observations": ("training.safetensors", lambda a: a.update(x=a.pop("observations"))),
    "observations of nothing": ("training.safetensors", lambda a: a.update(observations=np.zeros((3, 3)))),
    "observations beyond the table": ("training.safetensors", lambda a: a["observations"].fill(10**6)),
    "a small table": ("agent.safetensors", lambda a: a.update(action_values=np.zeros((2, 2)))),
    "a hyper-parameter of another type": ("agent.json", lambda v: v["config"].update(gamma="x")),
    "no poses": ("worlds.safetensors", lambda a: a.pop("pose")),
    "poses of other worlds": ("worlds.safetensors", lambda a: a.update(pose=np.zeros((3, 3)))),
    "cells of other worlds": ("worlds.safetensors", lambda a: a.update(cell=np.zeros((3, 3), dtype=np.int64))),
    "cells outside the layout": ("worlds.safetensors", lambda a: a["cell"].fill(10**6)),
    "goals outside the layout": ("worlds.safetensors", lambda a: a["goal"].fill(-(10**6))),
    "poses outside the layout": ("worlds.safetensors", lambda a: a["pose"].fill(1e6)),
    "poses that are none": ("worlds.safetensors", lambda a: a["pose"].fill(np.nan)),
    "streams beyond their block": ("worlds.safetensors", lambda a: a["streams.next"].fill(-(10**9))),
    "no transition": ("worlds.safetensors", lambda a: a.pop("transition.hit")),
    "no streams": ("worlds.json", lambda v: v.update(generators=[])),
    "a layout that is none": ("worlds.json", lambda v: v.update(layout="..\n.x")),
    "a layout that is a path": ("worlds.json", lambda v: v.update(layout="/etc/hostname")),
    "no layout": ("worlds.json", lambda v: v.pop("layout")),
    "fixed options that are none": ("worlds.json", lambda v: v.update(fixed={"goal": "x"})),
    "visits of another layout": ("visits.safetensors", lambda a: a.update(visits=np.zeros((2, 2), dtype=np.int64))),
    "no visits": ("visits.safetensors", lambda a: a.update(x=a.pop("visits"))),
}


def put(checkpoint: Path, part: str, change: Change) -> None:
    (edit if part.endswith("json") else edit_arrays)(checkpoint / part, change)


@pytest.mark.parametrize("wrong", WRONG)
def test_right_hashes_do_not_make_an_agent(wrong: str, run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Not passed over for the one before either: this is no accident."""
    put(checkpoints(run)[-1], *WRONG[wrong])
    before = contents(run)
    # What TensorBoard reads is told anew from the metrics at every start.
    of_tensorboard = {name for name in before if "tfevents" in name}

    for command in (["evaluate", str(run)], ["train", "--resume", "--run-dir", str(run)]):
        assert run_cli(*command) == 2
        assert checkpoints(run)[-1].name in one_line(capsys)
        after = contents(run)
        assert {n: after.get(n) for n in before.keys() - of_tensorboard} == {
            n: before[n] for n in before.keys() - of_tensorboard
        }


@pytest.mark.parametrize("wrong", WRONG_TRAINING)
def test_right_hashes_do_not_make_a_training(wrong: str, run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    put(cut_only(run), *WRONG_TRAINING[wrong])
    before = contents(run / "checkpoints")

    assert run_cli("train", "--resume", "--run-dir", str(run)) == 2

    told = [line for line in capsys.readouterr().err.splitlines() if line and not line.startswith("training")]
    (line,) = told  # beside the progress bar
    assert line.startswith("gridnav: ")
    assert len(line) <= 300
    assert contents(run / "checkpoints") == before


def test_a_finished_agent_without_its_training_cannot_pose_as_an_unfinished_one(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    edit(checkpoints(run)[-1] / "manifest.json", lambda m: m["standing"].update(is_finished=False))

    assert run_cli("train", "--resume", "--run-dir", str(run)) == 2

    assert "no training to go on with" in capsys.readouterr().err


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\x00" * 7,
        (2**63).to_bytes(8, "little") + b"{}",
        (2**64 - 1).to_bytes(8, "little"),
        (10**8 + 1).to_bytes(8, "little") + b"{" * 100,
        (2).to_bytes(8, "little") + b"[]",
        b"".join(
            (len(header).to_bytes(8, "little") + header)
            for header in [b'{"action_values":{"dtype":"F64","shape":[1,4],"data_offsets":[0,99999999]}}']
        ),
        b"".join(
            (len(header).to_bytes(8, "little") + header + b"\0" * 32)
            for header in [
                b'{"action_values":{"dtype":"F64","shape":[1,4],"data_offsets":[0,32]},'
                b'"b":{"dtype":"F64","shape":[1,4],"data_offsets":[0,32]}}'
            ]
        ),
    ],
)
def test_safetensors_that_lie_about_their_lengths_are_refused(
    content: bytes, run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    replace(checkpoints(run)[-1] / "agent.safetensors", content)

    assert run_cli("evaluate", str(run)) == 2

    assert "agent.safetensors" in one_line(capsys)


@pytest.mark.parametrize("hidden", [[16, 16], [-1], [0], ["x"], [10**12], [10**5, 10**5], 5, [[1]], [1.5], None])
@pytest.mark.parametrize("kind", ["ppo", "dqn"])
def test_a_networks_sizes_come_from_a_file_and_are_not_believed(
    kind: str, hidden: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A few bytes must not ask for gigabytes of memory."""
    from gymnasium.spaces import Box, Discrete

    from gridnav.agents import DQNAgent, DQNConfig, PPOAgent, PPOConfig
    from gridnav.experiment.checkpoint import load_agent, save_agent
    from gridnav.problem.types import InputError

    box = Box(-1.0, 1.0, (3,), np.float32)
    agents = {
        "ppo": lambda: PPOAgent(box, Box(-1.0, 1.0, (2,), np.float32), PPOConfig(hidden=(8,))),
        "dqn": lambda: DQNAgent(box, Discrete(4), DQNConfig(hidden=(8,))),
    }
    checkpoint = save_agent(agents[kind](), tmp_path, 1, name="net")
    edit(checkpoint / "agent.json", lambda v: v["config"].update(hidden=hidden))

    with pytest.raises(InputError) as caught:
        load_agent(tmp_path, "net")

    assert len(str(caught.value).replace(str(tmp_path), "")) <= 300
    assert str(caught.value).isprintable()


# ---- Configurations and evaluations ------------------------------------------------------------


@pytest.mark.parametrize(
    "content",
    [
        '{"command": "train", "seed": NaN}',
        '{"command": "train", "seed": 1, "seed": 2}',
        '{"a":' * 100_000,
        "[" * 100_000,
        '{"command": "train", "sed": 1}',
        '{"command": "train", "seed": -1}',
        '{"command": "train", "seed": 1e99}',
        '{"command": "train", "seed": {"a": 1}}',
        '{"command": "train", "budget": "huge"}',
        '{"command": "train", "agent": null}',
        '{"command": "train", "set": ["gamma=2"]}',
        '{"command": "train", "set": ["hidden=[16]"]}',
        '{"command": "train", "set": ["--run-dir", "/tmp/elsewhere"]}',
        '{"command": "train", "run_dir": "elsewhere"}',
        '{"command": "train", "resume": true}',
        '{"command": "train", "config": "other.json"}',
        '{"command": "train", "a\\nb": 1}',
        '{"command": "train", "layout": "\\ud800"}',
        '{"command": ["train"]}',
        "{}",
        "\ufeff{}",
    ],
)
def test_a_hostile_config_is_refused_in_one_line(content: str, run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (run / "config.json").write_text(content, encoding="utf-8")
    before = contents(run)

    assert run_cli("train", "--resume", "--run-dir", str(run)) == 2
    one_line(capsys)
    assert contents(run) == before
    if content != "{}":  # every default, as a new run may have
        assert run_cli("train", "--config", str(run / "config.json")) == 2
        one_line(capsys)
    assert list(Path.cwd().iterdir()) == []


@pytest.mark.parametrize("name", ["config.json", "evaluation.json"])
@pytest.mark.parametrize(
    "content",
    [
        b"", b"null", b"[]", b"\xff\xfe", b'{"results": 5, "layout": 5}', b'{"results": {"q": {}}}',
        b'{"results": {"q-learning": {"world": "x", "agent": "a", "carried": "", "checkpoint": "q-learning",'
        b' "observation": "cell_goal"}}, "layout": "classic", "task": "default", "reward": []}',
        b'{"results": {"q-learning": {"world": "GridWorld", "agent": "a", "carried": "", "checkpoint": ["x"],'
        b' "observation": 7}}, "layout": 1, "task": {}, "reward": 1}',
    ],
)  # fmt: skip
def test_a_run_that_was_tampered_with_is_not_evaluated(
    name: str, content: bytes, run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (run / name).write_bytes(content)

    assert run_cli("evaluate", str(run), "--episodes", "2") == 2

    one_line(capsys)


@pytest.mark.parametrize("slot", ["evaluation.json", "checkpoints/{}/manifest.json", "checkpoints/{}/agent.json"])
def test_a_pipe_in_the_place_of_a_file_does_not_hang(slot: str, run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    import os

    if not hasattr(os, "mkfifo"):
        pytest.skip("this system has no named pipes")
    file = run / slot.format(cut_only(run).name)
    file.unlink()
    os.mkfifo(file)

    assert run_cli("evaluate", str(run)) == 2

    one_line(capsys)


# ---- Code in files -----------------------------------------------------------------------------


class _Runs:
    """What unpickling makes it: a call."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.call = function, arguments

    def __reduce__(self) -> Any:
        return self.call


def payloads(marker: Path) -> dict[str, bytes]:
    """Files that make the marker when somebody runs what is in them."""
    import os

    shell = pickle.dumps(_Runs(os.system, f"touch {marker}"))
    evaluated = pickle.dumps(_Runs(eval, f"__import__('pathlib').Path({str(marker)!r}).touch()"))
    text = pickle.dumps(_Runs(eval, f"open({str(marker)!r}, 'w')"), protocol=0)
    archive, objects = io.BytesIO(), io.BytesIO()
    with zipfile.ZipFile(archive, "w") as file:  # as torch.save and stable-baselines3 write
        for name, content in (("archive/data.pkl", evaluated), ("archive/version", b"3"), ("data", shell)):
            file.writestr(name, content)
        file.writestr("../../escaped", b"zip slip")
    np.save(objects, np.array([_Runs(os.system, f"touch {marker}")], dtype=object), allow_pickle=True)
    header = json.dumps({"__metadata__": {"code": evaluated.hex()}, "_target_": "os.system"}).encode()
    return {
        "pickle of a shell command": shell,
        "pickle of eval": evaluated,
        "pickle in text": text,
        "torch archive": archive.getvalue(),
        "numpy objects": objects.getvalue(),
        "safetensors with a target": len(header).to_bytes(8, "little") + header,
        "json with a target": json.dumps(
            {"_target_": "os.system", "command": f"touch {marker}", "py/reduce": ["os.system", [f"touch {marker}"]]}
        ).encode(),
        "yaml": f"!!python/object/apply:os.system ['touch {marker}']".encode(),
    }


GUARDED = """
import contextlib, io, json, shutil, sys
from pathlib import Path

plan = json.loads(Path(sys.argv[1]).read_text())
import pickle, zipfile, numpy, torch  # whatever reads such files is there, so that a use would not be an import
from gridnav.cli import main

def run(words):
    with contextlib.redirect_stderr(io.StringIO()) as errors, contextlib.redirect_stdout(io.StringIO()):
        try:
            main(words)
        except SystemExit as leaving:
            return leaving.code, errors.getvalue()

allowed = [plan["root"], sys.prefix, sys.base_prefix, plan["repository"], "/proc", "/sys", "/dev", "/etc", "/usr"]
seen, watching = [], False

def guard(event, arguments):
    if not watching:
        return
    if event in ("pickle.find_class", "os.system", "os.exec", "os.posix_spawn", "os.fork", "subprocess.Popen",
                 "socket.connect", "ctypes.dlopen", "marshal.loads") or event.startswith("webbrowser"):
        seen.append([event, repr(arguments)[:200]])
    elif event in ("exec", "compile"):
        code = arguments[0] if event == "exec" else arguments[1]
        file = getattr(code, "co_filename", code)
        if not any(str(file).startswith(folder) for folder in (sys.prefix, sys.base_prefix, plan["repository"], "<")):
            seen.append([event, repr(arguments)[:200]])
    elif event == "open" and isinstance(arguments[0], (str, bytes)):
        path = Path(arguments[0] if isinstance(arguments[0], str) else arguments[0].decode()).absolute()
        if not any(str(path).startswith(folder) for folder in allowed) and not path.name.startswith("__editable__"):
            seen.append([event, str(path)])

sys.addaudithook(guard)
root, results = Path(plan["root"]), []
# Once without a payload and unwatched: what is loaded on first use, such as numba's own cache, is no payload's doing.
shutil.copytree(plan["template"], root / "first")
for words in (["evaluate", str(root / "first")], ["train", "--resume", "--run-dir", str(root / "first")]):
    code, errors = run(words)
    assert code == 0, errors
for number, (slot, payload) in enumerate(plan["cases"]):
    for words in (["evaluate", "RUN", "--episodes", "2"], ["train", "--resume", "--run-dir", "RUN"]):
        if slot == "evaluation.json" and words[0] == "train":
            continue  # it is written anew
        directory = root / "runs" / f"{number}-{words[0]}"
        shutil.copytree(plan["template"], directory)
        target = directory / slot
        target.write_bytes(Path(payload).read_bytes())
        if "step-" in slot and not slot.endswith("manifest.json"):
            import hashlib
            manifest = json.loads((target.parent / "manifest.json").read_text())
            content = target.read_bytes()
            manifest["parts"][target.name] = {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
            (target.parent / "manifest.json").write_text(json.dumps(manifest))
        watching = True
        code, errors = run([word.replace("RUN", str(directory)) for word in words])
        watching = False
        results.append([slot, payload, words[0], code, errors])
        shutil.rmtree(directory)
print(json.dumps({"results": results, "seen": seen}))
"""


def test_nothing_that_a_file_holds_is_ever_run(run: Path, tmp_path: Path) -> None:
    """Every payload in every place of a run, read by both commands that read runs, under an audit hook."""
    marker = tmp_path / "ran"
    # First of all the payloads work: what unpickles them makes the marker.
    for name in ("pickle of a shell command", "pickle of eval"):
        pickle.loads(payloads(marker)[name])
        assert marker.is_file()
        marker.unlink()
    cut_only(run)
    files = []
    for number, content in enumerate(payloads(marker).values()):
        files.append(tmp_path / f"payload-{number}")
        files[-1].write_bytes(content)
    newest = checkpoints(run)[-1]
    slots = [f"checkpoints/{newest.name}/{path.name}" for path in sorted(newest.iterdir())]
    slots += ["metrics.jsonl", "evaluation.json", "config.json"]
    plan = {
        "root": str(tmp_path), "template": str(run), "repository": str(Path(__file__).resolve().parents[1]),
        "cases": [(slot, str(file)) for slot in slots for file in files],
    }  # fmt: skip
    (tmp_path / "plan.json").write_text(json.dumps(plan))

    result = subprocess.run(
        [sys.executable, "-c", GUARDED, str(tmp_path / "plan.json")], capture_output=True, text=True, check=True
    )

    told = json.loads(result.stdout.splitlines()[-1])
    assert told["seen"] == []
    assert not marker.exists()
    assert not (tmp_path.parent / "escaped").exists()
    # A payload that is not read does no harm: metrics and training are none of the evaluation's business.
    ignored = {"metrics.jsonl", "training.json", "training.safetensors", "worlds.json", "worlds.safetensors"}
    ignored |= {"visits.json", "visits.safetensors"}
    for slot, payload, command, code, errors in told["results"]:
        assert "Traceback" not in errors
        name = slot.rpartition("/")[2]
        if (command == "evaluate" and name in ignored) or name == "visits.json":  # whose values nobody needs
            assert code in (0, 2)
        else:
            assert code == 2, (slot, payload, command, errors)


# ---- Disks -------------------------------------------------------------------------------------


@contextlib.contextmanager
def mounted(directory: Path, options: str) -> Iterator[Path]:
    """A file system in memory, where this user may mount one; the test is skipped elsewhere."""
    directory.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(directory)]
    try:
        done = subprocess.run(command, capture_output=True, check=False).returncode == 0
    except OSError:
        done = False
    if not done:
        pytest.skip("this user may not mount a file system")
    try:
        yield directory
    finally:
        subprocess.run(["umount", "--lazy", str(directory)], check=True)


def remount(directory: Path, options: str) -> None:
    subprocess.run(["mount", "-o", f"remount,{options}", str(directory)], check=True)


def test_a_full_disk_stops_training_with_the_last_checkpoint_whole(
    run: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with mounted(tmp_path / "disk", "size=8m") as disk:
        there = Path(shutil.copytree(run, disk / "run"))
        cut = cut_only(there)
        before = {path.name: path.read_bytes() for path in cut.iterdir()}
        # All but the last kilobytes are taken: the next checkpoint does not fit.
        with contextlib.suppress(OSError), (disk / "ballast").open("wb", buffering=0) as ballast:
            while True:
                ballast.write(b"\0" * 4096)
        capfd.readouterr()

        assert run_cli("train", "--resume", "--run-dir", str(there), "--checkpoint-s", "0") == 3

        told = [line for line in capfd.readouterr().err.splitlines() if line and not line.startswith("training")]
        assert len(told) == 1, told
        assert told[0].startswith("gridnav: ")
        assert "No space left" in told[0]
        assert {path.name: path.read_bytes() for path in cut.iterdir()} == before
        assert load_checkpoint(there / "checkpoints", "q-learning") is not None

        (disk / "ballast").unlink()
        assert run_cli("train", "--resume", "--run-dir", str(there)) == 0
        assert not list(there.rglob(".tmp-*"))


def test_a_new_run_on_a_full_disk_is_refused_in_one_line(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with mounted(tmp_path / "disk", "size=4k") as disk:
        (disk / "ballast").mkdir()

        assert run_cli("train", "--run-dir", str(disk / "run")) == 3

        told = [line for line in capfd.readouterr().err.splitlines() if line and not line.startswith("training")]
        assert len(told) == 1, told


def test_a_disk_that_may_only_be_read_can_be_evaluated_and_not_be_trained_on(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with mounted(tmp_path / "disk", "size=32m") as disk:
        there = Path(shutil.copytree(run, disk / "run"))
        remount(disk, "ro")
        before = contents(there)

        assert run_cli("train", "--resume", "--run-dir", str(there)) == 3
        assert "Read-only" in one_line(capsys)
        assert run_cli("train", "--run-dir", str(disk / "new")) == 3
        assert "Read-only" in one_line(capsys)
        assert run_cli("evaluate", str(there), "--episodes", "2") == 0
        assert contents(there) == before
