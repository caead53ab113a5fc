"""Names for the arrays that signatures carry; shapes are in each docstring."""

from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

Array: TypeAlias = npt.NDArray[np.float64]
"""Floating-point array; float64 unless a docstring says that float32 stays float32."""

Mask: TypeAlias = npt.NDArray[np.bool_]
Status: TypeAlias = npt.NDArray[np.uint8]
Image: TypeAlias = npt.NDArray[Any]
"""(height, width) or (height, width, channels), uint8 or uint16 or float32."""

Indices: TypeAlias = npt.NDArray[np.intp]
