"""Imports run one way: rainstereo <- {calib | model} <- apps; and what each floor may need is limited."""

import ast
import os
import subprocess
import sys
import textwrap
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
LONGEST = 450
FOLDERS = {
    "rainstereo": "rainstereo",
    "calib": "rainstereo.calib",
    "model": "rainstereo.model",
    "apps": "rainstereo.apps",
}
MAY_IMPORT = {"rainstereo": {"rainstereo"}, "calib": {"rainstereo", "calib"}, "model": {"rainstereo", "model"},
              "apps": {"rainstereo", "calib", "model", "apps"}}  # fmt: skip
CORE_NEEDS = {"rainstereo", "numpy", "cv2", "scipy"}
COMPILED_NEEDS = CORE_NEEDS | {"numba"}
HARDWARE_NEEDS = CORE_NEEDS | {"serial", "imagecodecs", "gi", "pypylon"}
MORE_NEEDS = {"rainstereo/compiled/": COMPILED_NEEDS, "rainstereo/hardware/": HARDWARE_NEEDS}
MRCAL_HERE = {"calib/mrcal_versions.py": "anywhere", "rainstereo/camera.py": "lazily"}
SAYS_NOTHING = {"utils", "util", "helpers", "helper", "common", "misc"}


def imports(path: Path, package: str) -> Iterator[tuple[str, int, bool]]:
    """Absolute name, line, and whether at import time, of everything that a module imports; the parts of
    `from x import y` too, since y may be a module. Type-checking blocks do not run, but do couple: they count."""
    tree = ast.parse(path.read_text(), str(path))
    lazy = {
        inner
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
        for inner in ast.walk(node)
    }
    home = package.split(".") + list(path.relative_to(path.parents[0]).parts[:-1])
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = [*home[: len(home) - node.level + 1]] if node.level else []
            base += node.module.split(".") if node.module else []
            found = [".".join([*base, alias.name]) for alias in node.names]
        elif isinstance(node, ast.Call) and _calls_import(node.func) and isinstance(node.args[0], ast.Constant):
            found = [str(node.args[0].value)]
        else:
            continue
        yield from ((name, node.lineno, node not in lazy) for name in found)


def _calls_import(function: ast.expr) -> bool:
    if isinstance(function, ast.Name):
        return function.id in ("__import__", "import_module")
    return isinstance(function, ast.Attribute) and function.attr == "import_module"


def floor(name: str) -> str | None:
    """The folder that a module of this name lies in; None for other people's."""
    parts = name.split(".")
    if parts[0] != "rainstereo":
        return None
    return parts[1] if len(parts) > 1 and parts[1] in FOLDERS and parts[1] != "rainstereo" else "rainstereo"


def violations(root: Path) -> list[str]:
    """Everything below `root` that breaks a rule of the layout, one line each."""
    found = []
    for folder, package in FOLDERS.items():
        for path in sorted((root / folder).rglob("*.py")):
            where = path.relative_to(root).as_posix()
            subpackage = ".".join([package, *path.relative_to(root / folder).parts[:-1]])
            if path.stem in SAYS_NOTHING or SAYS_NOTHING & set(path.parent.parts[len(root.parts) :]):
                found.append(f"{where}: a name that says nothing")
            length = len(path.read_text().splitlines())
            if length > LONGEST:
                found.append(f"{where}: {length} lines; at most {LONGEST}")
            for name, line, at_import_time in imports(path, subpackage):
                complaint = _complaint(folder, where, name, at_import_time)
                if complaint:
                    found.append(f"{where}:{line}: {complaint}")
    return found


def _complaint(folder: str, where: str, name: str, at_import_time: bool) -> str | None:
    top = name.split(".")[0]
    if top in ("calib", "model", "apps"):
        return f"imports {name}; import rainstereo.{name}"
    if top == "mrcal":
        allowed = MRCAL_HERE.get(where)
        if allowed is None or (allowed == "lazily" and at_import_time):
            return "imports mrcal; only calib/mrcal_versions.py does"
        return None
    target = floor(name)
    if target is not None and target not in MAY_IMPORT[folder]:
        return f"imports {name}; {folder} may not know of {target}"
    needs = next((needs for start, needs in MORE_NEEDS.items() if where.startswith(start)), CORE_NEEDS)
    if folder == "rainstereo" and top not in needs and top not in sys.stdlib_module_names:
        return f"imports {name}; the core needs only {', '.join(sorted(needs))}"
    return None


def test_project_keeps_its_layers() -> None:
    assert violations(ROOT) == []


def test_every_folder_is_looked_at() -> None:
    for folder in ("rainstereo", "calib", "apps"):
        assert any(list(imports(path, FOLDERS[folder])) for path in (ROOT / folder).rglob("*.py")), folder


BREACHES = {
    "core knows calib": ("rainstereo/a.py", "from rainstereo.calib import board", "may not know of calib"),
    "core knows apps, relatively": ("rainstereo/a.py", "from .apps import cli", "may not know of apps"),
    "core knows apps, from a subfolder": ("rainstereo/rain/a.py", "from ..apps import cli", "may not know of apps"),
    "core in a function": ("rainstereo/a.py", "def f():\n    import torch", "the core needs only"),
    "core by name": ("rainstereo/a.py", "import importlib\nimportlib.import_module('skimage')", "the core needs only"),
    "calib knows model": ("calib/a.py", "import rainstereo.model.train", "may not know of model"),
    "calib knows model, from the package": ("calib/a.py", "from rainstereo import model", "may not know of model"),
    "model knows calib, relatively": ("model/a.py", "from ..calib.board import Board", "may not know of calib"),
    "calib knows apps": ("calib/a.py", "from rainstereo.apps.report import Report", "may not know of apps"),
    "bare import": ("apps/a.py", "import calib.board", "import rainstereo.calib.board"),
    "mrcal in apps": ("apps/a.py", "def f():\n    import mrcal", "only calib/mrcal_versions.py"),
    "mrcal elsewhere in calib": ("calib/solve.py", "from mrcal import optimize", "only calib/mrcal_versions.py"),
    "mrcal at import time in camera": ("rainstereo/camera.py", "import mrcal", "only calib/mrcal_versions.py"),
    "serial in the core": ("rainstereo/a.py", "import serial", "the core needs only"),
    "numba in the core": ("rainstereo/rain/a.py", "def f():\n    import numba", "the core needs only"),
    "torch in hardware": ("rainstereo/hardware/a.py", "import torch", "the core needs only"),
    "utils": ("calib/utils.py", "x = 1", "a name that says nothing"),
    "common folder": ("apps/common/a.py", "x = 1", "a name that says nothing"),
    "too long": ("model/a.py", "x = 1\n" * (LONGEST + 1), f"at most {LONGEST}"),
}


@pytest.mark.parametrize("breach", BREACHES)
def test_each_breach_is_found(tmp_path: Path, breach: str) -> None:
    where, source, complaint = BREACHES[breach]
    (tmp_path / where).parent.mkdir(parents=True)
    (tmp_path / where).write_text(source)
    found = violations(tmp_path)
    assert len(found) == 1
    assert found[0].startswith(where)
    assert complaint in found[0]


def test_what_is_allowed_is_left_alone(tmp_path: Path) -> None:
    sources = {
        "rainstereo/camera.py": "import os\nimport numpy as np\nfrom .rig import Rig\ndef f():\n    import mrcal\n",
        "rainstereo/rain/render.py": "from ..warp import Warp\nfrom . import motion\nimport cv2, scipy.sparse\n",
        "calib/mrcal_versions.py": "import mrcal\nfrom rainstereo import Camera\nfrom . import board\n",
        "model/train.py": "import torch\nfrom rainstereo.warp import Warp\n",
        "apps/cli.py": "from rainstereo.calib import solve\nfrom rainstereo.model import train\nfrom . import report\n",
    }
    for where, source in sources.items():
        (tmp_path / where).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / where).write_text(source)
    assert violations(tmp_path) == []


def run_without(blocked: tuple[str, ...], body: str) -> subprocess.CompletedProcess[str]:
    """Run `body` in a fresh interpreter where the `blocked` packages cannot be imported."""
    blocker = f"""
        import sys, time
        class Blocker:
            def find_spec(self, name, path=None, target=None):
                if name.split(".")[0] in {blocked!r}:
                    raise ImportError(name + " is blocked", name=name)
        sys.meta_path.insert(0, Blocker())
    """
    source = textwrap.dedent(blocker) + textwrap.dedent(body)
    environment = {**os.environ, "RAINSTEREO_DEBUG": "0"}
    return subprocess.run(
        [sys.executable, "-c", source], capture_output=True, text=True, timeout=60, check=False, env=environment
    )


def test_core_works_without_mrcal_torch_and_the_rest(record_property: Callable[[str, object], None]) -> None:
    done = run_without(
        ("mrcal", "torch", "kornia", "skimage", "matplotlib", "tyro", "rich", "serial", "numba"),
        """
        started = time.perf_counter()
        from rainstereo import Camera, Chamber, Panel
        from rainstereo.refraction import project
        seconds = time.perf_counter() - started
        chamber = Chamber((0, 0, 1), 0.04, (Panel(0.004, 1.49),))
        pixels, status = project([[0.0, 0.0, 1.0]], Camera.pinhole(500, 500, 320, 240, 640, 480), chamber)
        assert pixels.tolist() == [[320.0, 240.0]] and status.tolist() == [0]
        print(seconds)
        """,
    )
    assert done.returncode == 0, done.stderr
    record_property("import_seconds", float(done.stdout))


def test_blocker_blocks() -> None:
    done = run_without(("numpy",), "import rainstereo\nrainstereo.Camera\n")
    assert done.returncode != 0
    assert "numpy is blocked" in done.stderr


def test_help_needs_no_heavy_package() -> None:
    done = run_without(
        ("mrcal", "torch", "matplotlib", "tyro", "rich", "skimage"),
        "from rainstereo.apps.cli import main\nsys.exit(main(['--help']))\n",
    )
    assert done.returncode == 0, done.stderr
    assert "commands:" in done.stdout
