"""The console command `rainstereo`: finds the subcommand, runs it, turns what went wrong into words and a status.

A subcommand is a module of this folder with a frozen dataclass `Options` (its docstrings are the help that
`rainstereo NAME --help` shows) and `run(options) -> int`. It joins the command with one line in `COMMANDS`.
Only the module that is asked for is imported, so the general help appears at once.
"""

from __future__ import annotations

import difflib
import importlib
import os
import sys
import textwrap
from collections.abc import Mapping, Sequence
from typing import NamedTuple

DONE, FAILED, BAD_USAGE, INTERRUPTED = 0, 1, 2, 130


class Command(NamedTuple):
    """One subcommand: the line that the general help gives it, and a command line that works."""

    summary: str
    example: str


COMMANDS: dict[str, Command] = {
    "demo": Command(
        "a digital rig, recorded, calibrated, aligned and rained on: see it all at once",
        "rainstereo demo --out out/demo",
    ),
    "simulate": Command(
        "a recording by a digital rig, and the truth about it", "rainstereo simulate --out out/recording"
    ),
    "board": Command(
        "a calibration board to print at exact scale, and its description",
        "rainstereo board chessboard:9x6:25mm --out board.pdf",
    ),
    "calibrate": Command(
        "board images to a rig folder, through the acrylic",
        "rainstereo calibrate --dry boards/dry --wet boards/wet --board chessboard:9x6:25mm --out rig",
    ),
    "convert": Command(
        "calibrations from and for OpenCV, ROS and Kalibr", "rainstereo convert camchain.yaml --out rig"
    ),
    "align": Command(
        "a recording to undistorted, cropped, aligned pairs",
        "rainstereo align --dry drive/dry --wet drive/wet --rig rig --out aligned",
    ),
    "select": Command(
        "aligned pairs to a data set of an exact size, split without leaks",
        "rainstereo select aligned --count 4818 --reserve 500 --out dataset",
    ),
    "droplets": Command(
        "where simple drop models are good to a pixel, and where not", "rainstereo droplets --out out/droplets"
    ),
    "rain": Command("adherent rain on any image", "rainstereo rain drive --out rainy --preset camvid --psnr 16.9"),
    "derain": Command("rain off images, videos and cameras", "rainstereo derain photo.png --out out/derained"),
    "evaluate": Command(
        "how much de-raining helps: the paper's tables on your data",
        "rainstereo evaluate restoration camvid:frames --out out/evaluation",
    ),
    "export": Command("the de-rainer as ONNX, for other programs", "rainstereo export --out derain.onnx"),
    "detector": Command(
        "the network that says where drops are, for derain to skip the rest",
        "rainstereo detector frames --out detector.safetensors",
    ),
    "train": Command("a de-raining network, from a recipe", "rainstereo train recipe.toml --out out/train"),
    "record": Command(
        "cameras and pump to a recording that survives a crash; verify, repair and export one",
        "rainstereo record --dry aravis:DRY --wet aravis:WET --out drive",
    ),
    "pump": Command(
        "drive the rig's pump: status, run, schedule, stop, monitor", "rainstereo pump run mist --simulate"
    ),
    "bench": Command("time and error of each way to do the same work", "rainstereo bench refraction --out out/bench"),
}

ACTIONS: dict[str, tuple[str, ...]] = {"evaluate": ("segmentation",)}
"""Second words that have options of their own: `evaluate segmentation` is the module evaluate_segmentation."""

_REMEDIES = {
    "mrcal": "sudo apt-get install python3-mrcal (Debian, Ubuntu); from Python 3.12 on: pip install --no-deps mrcal",
    "torch": "pip install torch",
    "kornia": "pip install kornia",
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line `argv` (default: the process's own) and return the exit status.

    0: done. 1: the work failed. 2: bad usage or input (a `ValueError` or a file that is not there), told in one
    paragraph on stderr. 130: interrupted. With `--debug`, or `RAINSTEREO_DEBUG=1`, exceptions are not caught.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    debug = os.environ.get("RAINSTEREO_DEBUG", "0") not in ("", "0")
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")  # we name damaged files ourselves
    while "--debug" in arguments:
        arguments.remove("--debug")
        debug = True
    if not arguments:
        print(help_text(COMMANDS), file=sys.stderr)
        return BAD_USAGE
    name, *rest = arguments
    if name in ("-h", "--help", "help"):
        return main([*rest, "--help"]) if name == "help" and rest else _say(help_text(COMMANDS))
    if name in ("-V", "--version"):
        return _say(_version_text())
    if name not in COMMANDS:
        return _complain(_unknown(name))
    try:
        return _run(name, rest)
    except SystemExit as stop:  # the option parser: 0 after --help, 2 after a mistake
        return _exit_status(stop)
    except KeyboardInterrupt:
        print(f"\nrainstereo {name}: interrupted, nothing half-written", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:  # the reader of our output went away, as `| head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    except Exception as error:
        if debug:
            raise
        status, words = _explain(error)
        return _complain(f"rainstereo {name}: {words}", status)


def help_text(commands: Mapping[str, Command]) -> str:
    """What `rainstereo --help` prints: the commands, and what to do next."""
    width = max(map(len, commands))
    listed = "\n".join(f"  {name:<{width}}  {command.summary}" for name, command in commands.items())
    examples = "\n".join(f"  {command.example}" for command in commands.values())
    return f"""\
usage: rainstereo COMMAND [options]

A narrow-baseline stereo rig that looks through rain: calibrate it through its acrylic, record, turn its
recordings into aligned wet and dry pairs, render rain, and train and run what takes it away.

commands:
{listed}

  rainstereo COMMAND --help   options of one command
  rainstereo --version        versions of everything that numbers depend on

to begin:
{examples}

Every command writes report.json, and report.html where pictures say it better.
Exit status: 0 done, 1 the work failed, 2 bad usage or input. --debug shows where an error came from."""


def _run(name: str, arguments: Sequence[str]) -> int:
    words = [name, *arguments[:1]] if arguments and arguments[0] in ACTIONS.get(name, ()) else [name]
    module = importlib.import_module(f"rainstereo.apps.{'_'.join(words)}")
    arguments = arguments[len(words) - 1 :]
    import tyro

    style = (tyro.conf.FlagCreatePairsOff,)  # a switch that is off has --quick, and no --no-quick beside it
    options = tyro.cli(module.Options, prog=f"rainstereo {' '.join(words)}", args=list(arguments), config=style)
    return int(module.run(options))


def _explain(error: Exception) -> tuple[int, str]:
    """Exit status and words for an exception that left a command."""
    if isinstance(error, ModuleNotFoundError) and (error.name or "").split(".")[0] in _REMEDIES:
        package = str(error.name).split(".", maxsplit=1)[0]
        return FAILED, f"this needs {package}, which is not installed. Get it: {_REMEDIES[package]}"
    if isinstance(error, FileNotFoundError) and error.filename is not None:
        return BAD_USAGE, f"no such file or folder: {error.filename}"
    words = str(error).strip() or type(error).__name__
    if isinstance(error, (FileNotFoundError, NotADirectoryError, IsADirectoryError, FileExistsError)):
        return BAD_USAGE, words
    if isinstance(error, ValueError) and type(error).__name__ != "LinAlgError":  # that one is a solve that failed
        return BAD_USAGE, words
    if isinstance(error, (RuntimeError, OSError, ArithmeticError, MemoryError, ImportError)):
        return FAILED, words
    return FAILED, f"unexpected {type(error).__name__}: {words}. Please report it with what --debug shows."


def _unknown(name: str) -> str:
    near = difflib.get_close_matches(name, COMMANDS, n=1)
    guess = f" Did you mean {near[0]}?" if near else ""
    return (
        f"rainstereo: there is no command {name!r}.{guess} The commands: {', '.join(COMMANDS)}. See rainstereo --help."
    )


def _version_text() -> str:
    from rainstereo.apps.run_record import versions

    found = versions()
    width = max(map(len, found))
    return "\n".join(f"{name:<{width}}  {version}" for name, version in found.items())


def _exit_status(stop: SystemExit) -> int:
    if stop.code is None:
        return DONE
    return stop.code if isinstance(stop.code, int) else _complain(str(stop.code), FAILED)


def _say(text: str) -> int:
    print(text)
    return DONE


def _complain(text: str, status: int = BAD_USAGE) -> int:
    """Each line of the text wrapped by itself: a list, file by file, stays a list."""
    for line in text.splitlines():
        print(textwrap.fill(line, 100, break_long_words=False, break_on_hyphens=False), file=sys.stderr)
    return status


if __name__ == "__main__":
    sys.exit(main())
