"""Rig geometry and optics of a stereo pair that looks through rain."""

from .camera import Camera
from .chamber import Chamber, Panel
from .rig import Rig
from .warp import Warp

__version__ = "0.1.0"
__all__ = ["Camera", "Chamber", "Panel", "Rig", "Warp"]
