"""What holds for every test: one thread, an empty working folder, and Hypothesis without a clock."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

# Torch reads it when it is first imported, which most tests never do. Small networks only lose by more threads.
os.environ.setdefault("OMP_NUM_THREADS", "1")

# The first call of a compiled function takes seconds, and other work may share the cores: no deadline.
settings.register_profile("gridnav", deadline=None, max_examples=50, database=None, print_blob=False)
settings.load_profile("gridnav")


@pytest.fixture(scope="session", autouse=True)
def _away_from_the_repository(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Fixtures that outlive a test work in a folder of their own: MuJoCo leaves a log where it stands."""
    before = Path.cwd()
    os.chdir(tmp_path_factory.mktemp("session"))
    yield
    os.chdir(before)


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """Relative paths of one test are not in the way of another; ``tmp_path`` holds nothing but the test's own files."""
    monkeypatch.chdir(tmp_path_factory.mktemp("cwd"))
