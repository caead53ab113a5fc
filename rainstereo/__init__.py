"""Rig geometry and optics of a stereo pair that looks through rain.

Names are imported when they are first used, so that `rainstereo --help` need not wait for numpy and OpenCV.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .camera import Camera as Camera
    from .chamber import Chamber as Chamber
    from .chamber import Panel as Panel
    from .rig import Rig as Rig
    from .warp import Warp as Warp

__version__ = "0.1.0"
__all__ = ["Camera", "Chamber", "Panel", "Rig", "Warp"]

_HOMES = {"Camera": "camera", "Chamber": "chamber", "Panel": "chamber", "Rig": "rig", "Warp": "warp"}


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f".{_HOMES[name]}", __name__), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
