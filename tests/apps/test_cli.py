"""The command line: what it says, and the exit status that scripts rely on."""

import dataclasses
import importlib
import re
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rainstereo.apps import cli


@dataclasses.dataclass(frozen=True)
class Options:
    """Does what the test says."""

    count: int = 1
    """How often."""
    out: Path = Path("out")
    """Where to."""


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[Options], int]], None]:
    """Adds a command `probe` that runs the given function."""

    def add(run: Callable[[Options], int]) -> None:
        module: Any = types.ModuleType("rainstereo.apps.probe")
        module.Options, module.run = Options, run
        monkeypatch.setitem(sys.modules, "rainstereo.apps.probe", module)
        monkeypatch.setitem(cli.COMMANDS, "probe", cli.Command("a probe", "rainstereo probe"))

    return add


def failing(error: BaseException) -> Callable[[Options], int]:
    def run(options: Options) -> int:
        raise error

    return run


def test_options_reach_the_command_and_its_status_comes_back(command: Any) -> None:
    seen: list[Options] = []
    command(lambda options: seen.append(options) or 1)
    assert cli.main(["probe", "--count", "3", "--out", "a/b"]) == 1
    assert seen == [Options(3, Path("a/b"))]


@pytest.mark.parametrize(
    ("error", "status", "words"),
    [
        (ValueError("--count is 0;\n expected 1"), 2, "rainstereo probe: --count is 0; expected 1"),
        (
            FileNotFoundError(2, "No such file or directory", "rig/wet.cameramodel"),
            2,
            "no such file or folder: rig/wet",
        ),
        (FileNotFoundError("no images in cam0"), 2, "no images in cam0"),
        (NotADirectoryError("x is a file"), 2, "x is a file"),
        (RuntimeError("the solve did not converge"), 1, "rainstereo probe: the solve did not converge"),
        (np.linalg.LinAlgError("Singular matrix"), 1, "Singular matrix"),
        (OSError(28, "No space left on device"), 1, "No space left"),
        (ModuleNotFoundError("No module named 'mrcal'", name="mrcal"), 1, "apt-get install python3-mrcal"),
        (KeyError("rt"), 1, "unexpected KeyError"),
        (KeyboardInterrupt(), 130, "interrupted, nothing half-written"),
    ],
)
def test_what_went_wrong_becomes_words_and_a_status(
    command: Any, capsys: pytest.CaptureFixture[str], error: BaseException, status: int, words: str
) -> None:
    command(failing(error))
    assert cli.main(["probe"]) == status
    told = capsys.readouterr()
    assert words in " ".join(told.err.split())
    assert "Traceback" not in told.err
    assert told.out == ""


@pytest.mark.parametrize("how", ["flag before", "flag after", "environment"])
def test_debug_lets_the_exception_through(command: Any, monkeypatch: pytest.MonkeyPatch, how: str) -> None:
    command(failing(ValueError("deep inside")))
    if how == "environment":
        monkeypatch.setenv("RAINSTEREO_DEBUG", "1")
    arguments = {"flag before": ["--debug", "probe"], "flag after": ["probe", "--debug"], "environment": ["probe"]}
    with pytest.raises(ValueError, match="deep inside"):
        cli.main(arguments[how])


def test_an_option_that_does_not_exist_is_bad_usage(command: Any, capsys: pytest.CaptureFixture[str]) -> None:
    command(lambda options: 0)
    assert cli.main(["probe", "--colour", "red"]) == 2
    assert "--colour" in "".join(capsys.readouterr())


def test_an_unknown_command_is_bad_usage_and_gets_a_guess(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["bnech"]) == 2
    assert "Did you mean bench?" in capsys.readouterr().err


def test_no_command_is_bad_usage_and_shows_the_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([]) == 2
    assert "usage: rainstereo COMMAND" in capsys.readouterr().err


def test_help_names_every_command_and_examples_that_exist(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--help"]) == 0
    told = capsys.readouterr().out
    for name, entry in cli.COMMANDS.items():
        assert f"  {name} " in told
        assert entry.summary in told
    examples = re.findall(r"^  rainstereo (\w+) ", told.split("to begin:")[1], flags=re.MULTILINE)
    assert examples
    assert set(examples) <= set(cli.COMMANDS)


def test_version_names_what_numbers_depend_on(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--version"]) == 0
    told = dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines())
    assert told["numpy"] == np.__version__
    assert {"rainstereo", "python", "opencv"} <= told.keys()


@pytest.mark.parametrize("name", list(cli.COMMANDS))
def test_every_command_declares_options_with_help(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    module = importlib.import_module(f"rainstereo.apps.{name}")
    assert dataclasses.is_dataclass(module.Options)
    assert module.Options.__dataclass_params__.frozen
    assert callable(module.run)
    assert cli.main([name, "--help"]) == 0
    told = capsys.readouterr().out
    assert f"usage: rainstereo {name}" in told
    first_words = " ".join((module.Options.__doc__ or "").split()[:3])
    assert first_words in " ".join(told.replace("│", " ").split())


def test_help_of_a_command_by_the_word_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["help", "bench"]) == 0
    assert "usage: rainstereo bench" in capsys.readouterr().out
