"""What is known of the panels before any board is looked at: caliper, protractor, data sheet."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rainstereo.calib import slab as slabs
from rainstereo.calib.slab import Kind, Slab
from rainstereo.chamber import Chamber
from rainstereo.types import Array

KINDS: tuple[Kind, ...] = ("tilt", "thickness", "index")


@dataclass(frozen=True)
class Prior:
    """Gaussian knowledge of a slab: the chamber described, with its standard deviations.

    kinds: which of `KINDS` are known; those that are not are left to the boards alone. A wedge is never known.
    """

    chamber: Chamber
    kinds: tuple[Kind, ...] = KINDS

    def sigmas(self, slab: Slab) -> Array:
        """Standard deviation of each of the slab's parameters, (P,), as its names lists them; inf where not known.

        Of a material's panels the thicknesses add up and err independently; the index is one, and errs together.
        """
        sd = self.chamber.with_uncertainty().uncertainty
        assert sd is not None
        materials = np.array(slab.materials, dtype=int)
        of_kind: dict[Kind, list[float]] = {
            "tilt": [sd.tilt] * 2,
            "thickness": [float(np.linalg.norm(np.array(sd.thickness)[materials == m])) for m in slab.thick],
            "index": [float(np.array(sd.index)[materials == m].max()) for m in range(slab.count)],
            "wedge": [np.inf] * 2,
        }
        return np.array(
            [value if kind in self.kinds else np.inf for kind in slab.free for value in of_kind[kind]], dtype=float
        )

    def rows(self, slab: Slab) -> tuple[Array, Array]:
        """Residuals in sigmas, (K,), and their derivatives by the slab's parameters, (K, P).

        The tilt's three are the chord between the two normals; its length is the angle, to a part in 24 squared angles.
        """
        sigmas, names = self.sigmas(slab), slab.names
        known = Slab(self.chamber, slab.free, materials=slab.materials)
        off, J = [np.zeros(0)], [np.zeros((0, len(names)))]
        if "tilt" in slab.free and np.isfinite(sigmas[0]):
            axes = np.zeros((3, len(names)))
            axes[:, :2] = slabs.across(slab.chamber.normal)
            off.append((np.array(slab.chamber.normal) - np.array(self.chamber.normal)) / sigmas[0])
            J.append(axes / sigmas[0])
        for k, (now, then) in enumerate(zip(slab.values, known.values, strict=True)):
            if names[k].startswith(("thickness", "index")) and np.isfinite(sigmas[k]):
                off.append(np.array([(now - then) / sigmas[k]]))
                J.append(np.eye(len(names))[k : k + 1] / sigmas[k])
        return np.concatenate(off), np.concatenate(J)

    def chi2(self, slab: Slab) -> float:
        """Sum of the squared residuals."""
        off, _ = self.rows(slab)
        return float(off @ off)

    def pulls(self, slab: Slab) -> dict[str, float]:
        """How far the slab stands from what was known, in standard deviations of that, by name: parameters that have a
        prior only.
        """  # fmt: skip
        sigmas, names, told = self.sigmas(slab), slab.names, {}
        known = Slab(self.chamber, slab.free, materials=slab.materials)
        if "tilt" in slab.free and np.isfinite(sigmas[0]):
            axes = slabs.across(self.chamber.normal)
            off = np.array(slab.chamber.normal) @ axes / sigmas[0]
            told |= {"pitch": float(off[0]), "yaw": float(off[1])}
        for k, (now, then) in enumerate(zip(slab.values, known.values, strict=True)):
            if names[k].startswith(("thickness", "index")) and np.isfinite(sigmas[k]):
                told[names[k]] = float((now - then) / sigmas[k])
        return told
