"""The panels as something to be found: which of their parameters are free, and how a camera's view depends on them.

Parallel panels of one index act on everything behind them as one slab, so only the thickness of each *material* (all
panels of one index together) can be known from boards; what it changes is shared among its panels in proportion to the
variances of their measurements. Distance and gaps do not matter at all and keep the values described.

The normal moves across itself: "pitch" lowers it in the image, "yaw" moves it to the right, in radians, from wherever
it stands. So nothing is singular at tilt zero, where the angles of a polar description exchange roles.

A wedge is a panel whose faces are not parallel. W, a vector across the normal in radians, is the far face's normal
minus the near face's. To first order in W a ray of direction d (unit, c = d.n) leaves in the direction

    d - g(c) (W - (W.d / c) n),    g(c) = sqrt(N^2 - 1 + c^2) - c

(Snell's law at both faces: N s = d + g1 n1, d' = N s - g2 n2), so a point that without the wedge seems to be at P'
seems to be at P' + L g(c) (W - (W.d / c) n), with L the length of the ray behind the wedge. Wedges of several panels
add up; it is taken to stand in the middle of the stack.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal, TypeAlias

import numpy as np

from rainstereo import refraction, types
from rainstereo.chamber import INDEX_RANGE, THICKNESS_RANGE, Chamber, Panel
from rainstereo.types import Array, Mask

Kind: TypeAlias = Literal["tilt", "thickness", "index", "wedge"]
KINDS: tuple[Kind, ...] = ("tilt", "thickness", "index", "wedge")
LONGEST_TURN = np.deg2rad(10.0)
"""The normal turns by no more than this in one step."""


@dataclass(frozen=True)
class Slab:
    """Panels at their present values, and which kinds of parameters are free.

    chamber: in the frame of the first (dry) camera. free: some of `KINDS`, kept in that order.
    wedge: W, three numbers across the normal, radians.
    materials: for each panel the number of its material; panels share one if their indices are equal to begin with.
    """

    chamber: Chamber
    free: tuple[Kind, ...] = ()
    wedge: tuple[float, float, float] = (0.0, 0.0, 0.0)
    materials: tuple[int, ...] = field(default=())

    def __post_init__(self) -> None:
        if unknown := sorted(set(self.free) - set(KINDS)):
            raise ValueError(f"{', '.join(unknown)} of a slab cannot be estimated; expected some of {', '.join(KINDS)}")
        object.__setattr__(self, "free", tuple(kind for kind in KINDS if kind in self.free))
        panels = self.chamber.panels
        if not self.materials and panels:
            indices = list(dict.fromkeys(panel.index for panel in panels))
            object.__setattr__(self, "materials", tuple(indices.index(panel.index) for panel in panels))

    @property
    def thick(self) -> tuple[int, ...]:
        """Materials that have a thickness to be found: all but a last one without end."""
        panels = zip(self.materials, self.chamber.panels, strict=True)
        endless = {material for material, panel in panels if np.isinf(panel.thickness)}
        return tuple(m for m in range(self.count) if m not in endless)

    @property
    def count(self) -> int:
        """Number of materials."""
        return max(self.materials, default=-1) + 1

    @property
    def names(self) -> tuple[str, ...]:
        """What is estimated, in the order of every Jacobian and covariance: "pitch", "yaw" (radians), "thickness 0",
        ... (metres, of each material), "index 0", ..., "wedge pitch", "wedge yaw" (radians).
        """  # fmt: skip
        of_kind: dict[Kind, tuple[str, ...]] = {
            "tilt": ("pitch", "yaw"),
            "thickness": tuple(f"thickness {m}" for m in self.thick),
            "index": tuple(f"index {m}" for m in range(self.count)),
            "wedge": ("wedge pitch", "wedge yaw"),
        }
        return tuple(name for kind in self.free for name in of_kind[kind])

    @property
    def values(self) -> Array:
        """(P,), as `names` lists them. Pitch and yaw here: the normal's angles below and right of the dry camera's
        axis; their changes are those of the parameters only near tilt zero, and no sum with a step is meant.
        """  # fmt: skip
        x, y, z = self.chamber.normal
        axes = across(self.chamber.normal)
        of_kind: dict[Kind, list[float]] = {
            "tilt": [float(np.arctan2(y, np.hypot(x, z))), float(np.arctan2(x, z))],
            "thickness": [self.thickness(m) for m in self.thick],
            "index": [self.index(m) for m in range(self.count)],
            "wedge": (np.asarray(self.wedge) @ axes).tolist(),
        }
        return np.array([value for kind in self.free for value in of_kind[kind]])

    def thickness(self, material: int) -> float:
        """Of all panels of a material together, metres."""
        panels = zip(self.materials, self.chamber.panels, strict=True)
        return float(sum(panel.thickness for m, panel in panels if m == material))

    def index(self, material: int) -> float:
        """Of a material."""
        return self.chamber.panels[self.materials.index(material)].index

    def shares(self) -> Array:
        """(panels,) of what each material's thickness changes by, the part that falls to each panel."""
        panels, sd = self.chamber.panels, self.chamber.uncertainty
        weight = np.zeros(len(panels)) if sd is None else np.square(sd.thickness)
        materials = np.array(self.materials)
        for m in range(self.count):
            mine = materials == m
            if not weight[mine].any():
                weight[mine] = [
                    p.thickness if np.isfinite(p.thickness) else 0.0 for p in np.array(panels, object)[mine]
                ]
            if not weight[mine].any():
                weight[mine] = 1.0
            weight[mine] /= weight[mine].sum()
        return weight

    def moved(self, step: Array) -> Slab:
        """The slab after a step of its parameters, (P,); thickness and index stay in the range of what can be.

        The normal turns by at most LONGEST_TURN; `limited` tells which parameters stand at the end of their range.
        """
        parts = self._parts(np.asarray(step, dtype=np.float64))
        normal, wedge = np.asarray(self.chamber.normal), np.asarray(self.wedge)
        axes = across(normal)
        turn = axes @ parts["tilt"]
        angle = float(np.linalg.norm(turn))
        if angle > 0:
            turn *= min(1.0, LONGEST_TURN / angle)
            angle = min(angle, LONGEST_TURN)
            rotated = np.cos(angle) * normal + np.sin(angle) * turn / angle
        else:
            rotated = normal
        wedge = wedge + axes @ parts["wedge"]
        wedge = wedge - (wedge @ rotated) / (1 + normal @ rotated) * (normal + rotated)  # carried along with the normal
        thicker, shares = np.zeros(self.count), self.shares()
        for m, change in zip(self.thick, parts["thickness"], strict=True):
            low = THICKNESS_RANGE[0] - self.thickness(m)
            thicker[m] = max(change, low)
        panels = tuple(
            Panel(
                float(np.clip(panel.thickness + thicker[m] * share, *THICKNESS_RANGE))
                if np.isfinite(panel.thickness)
                else panel.thickness,
                float(np.clip(panel.index + parts["index"][m], *INDEX_RANGE)),
            )
            for panel, m, share in zip(self.chamber.panels, self.materials, shares, strict=True)
        )
        x, y, z = rotated.tolist()
        wx, wy, wz = wedge.tolist()
        return replace(self, chamber=replace(self.chamber, normal=(x, y, z), panels=panels), wedge=(wx, wy, wz))

    def limited(self) -> tuple[Mask, Mask]:
        """Which parameters stand at the lower and at the upper end of their range, (P,) each."""
        low = (
            [self.thickness(m) <= THICKNESS_RANGE[0] for m in self.thick],
            [self.index(m) <= INDEX_RANGE[0] for m in range(self.count)],
        )
        high = [False] * len(self.thick), [self.index(m) >= INDEX_RANGE[1] for m in range(self.count)]
        ends = []
        for thickness, index in (low, high):
            of_kind: dict[Kind, list[bool]] = {
                "tilt": [False] * 2, "thickness": list(thickness), "index": list(index), "wedge": [False] * 2
            }  # fmt: skip
            ends.append(np.array([end for kind in self.free for end in of_kind[kind]], dtype=np.bool_))
        return ends[0], ends[1]

    def _parts(self, step: Array) -> dict[Kind, Array]:
        """A step by kind, zero for what is not free."""
        sizes: dict[Kind, int] = {"tilt": 2, "thickness": len(self.thick), "index": self.count, "wedge": 2}
        if step.shape != (len(self.names),):
            raise ValueError(f"a step of shape {step.shape} was given; this slab has {len(self.names)} parameters")
        parts, start = {}, 0
        for kind in KINDS:
            taken = sizes[kind] if kind in self.free else 0
            parts[kind] = step[start : start + taken] if taken else np.zeros(sizes[kind])
            start += taken
        return parts


@dataclass(frozen=True, eq=False)
class View:
    """Where a camera seems to see N points, (N, 3), and how that moves; P parameters as `Slab.names` lists them.

    All in the reference frame's orientation, from the camera's centre. point: (N, 3, 3). parameters: (N, 3, P).
    centre: (N, 3, 3), by the camera's place with the points' places from it held: a wedge alone is sensitive to that.
    """

    seen: Array
    status: types.Status
    point: Array
    parameters: Array
    centre: Array


def apparent(slab: Slab, points: Array, centre: Array) -> tuple[Array, types.Status]:
    """Where a camera at `centre`, (3,) in the reference frame, seems to see points, (N, 3) relative to it."""
    seen, status = refraction.apparent(points, _seen_from(slab, centre))
    if any(slab.wedge):
        seen = seen + _deviation(slab, seen, centre)[0]
    return seen, status


def view(slab: Slab, points: Array, centre: Array) -> View:
    """`apparent` with its derivatives."""
    bend = refraction.apparent_gradients(points, _seen_from(slab, centre))
    if not slab.free and not any(slab.wedge):
        nothing = np.zeros((len(points), 3, 0))
        return View(bend.seen, bend.status, bend.point, nothing, np.zeros((len(points), 3, 3)))
    axes, materials = across(slab.chamber.normal), np.array(slab.materials, dtype=int)
    mine = np.eye(slab.count)[materials].reshape(len(materials), slab.count)
    columns: dict[Kind, Array] = {
        "tilt": bend.normal @ axes,
        "thickness": (bend.thickness * slab.shares()) @ mine[:, list(slab.thick)],
        "index": bend.index @ mine,
        "wedge": np.zeros((len(points), 3, 2)),
    }
    seen, point, by_centre = bend.seen, bend.point, np.zeros((len(points), 3, 3))
    if any(slab.wedge) or "wedge" in slab.free:
        moved, by_seen, by_normal, by_index, by_wedge, by_centre = _deviation(slab, bend.seen, centre)
        columns = {kind: column + by_seen @ column for kind, column in columns.items()}
        columns["tilt"] = columns["tilt"] + by_normal @ axes
        columns["index"][..., slab.materials[0]] += by_index
        columns["wedge"] = by_wedge @ axes
        seen, point = seen + moved, point + by_seen @ point
    parameters = [columns[kind] for kind in slab.free]
    stacked = np.concatenate([np.zeros((len(points), 3, 0)), *parameters], -1)
    return View(seen, bend.status, point, stacked, by_centre)


def across(normal: tuple[float, float, float] | Array) -> Array:
    """Two unit vectors across a normal, (3, 2): pitch (downwards in the image) and yaw (to its right)."""
    n = np.asarray(normal, dtype=np.float64)
    right = np.array([1.0, 0, 0]) if abs(n[0]) < 0.99 else np.array([0, 0, -1.0])
    yaw = right - (right @ n) * n
    yaw /= np.linalg.norm(yaw)
    return np.stack([np.cross(n, yaw), yaw], -1)


def _seen_from(slab: Slab, centre: Array) -> Chamber:
    """The chamber, same orientation, from another place."""
    return slab.chamber.transformed(np.concatenate([np.zeros(3), -np.asarray(centre)]))


def _deviation(slab: Slab, seen: Array, centre: Array) -> tuple[Array, Array, Array, Array, Array, Array]:
    """How the wedge moves points seen at P', (N, 3), and derivatives: by P', by the normal (N, 3, 3; the wedge is
    carried along), by the index of the first material (N, 3), by W, by the camera's centre (N, 3, 3).
    """  # fmt: skip
    n, W, N = np.asarray(slab.chamber.normal), np.asarray(slab.wedge), slab.chamber.panels[0].index
    gaps = np.concatenate([[0.0], np.cumsum(slab.chamber.gaps)])
    D = slab.chamber.distance + float(gaps.mean()) - float(n @ centre)  # air before the wedge, along the normal
    z, L = seen @ n, np.linalg.norm(seen, axis=-1)
    c = z / L
    root = np.sqrt(N**2 - 1 + c**2)
    g, g_c = root - c, c / root - 1
    h, q = L * (1 - D / z) * g, seen @ W / z
    v = W - q[:, None] * n

    def outer(a: Array, b: Array) -> Array:
        return np.asarray(a[..., :, None] * b[..., None, :])

    direction = seen / L[:, None]
    normals = np.broadcast_to(n, seen.shape)
    # derivatives of c, h and q by P' and by n are row vectors (N, 3)
    c_P = (normals - c[:, None] * direction) / L[:, None]
    h_c, h_z = L * (1 - D / z) * g_c, L * g * D / z**2
    h_P = (h / L)[:, None] * direction + h_z[:, None] * n + h_c[:, None] * c_P
    q_P = (W - q[:, None] * n) / z[:, None]
    h_n = h_z[:, None] * seen + h_c[:, None] * seen / L[:, None] + (L * g / z)[:, None] * centre
    q_n = -(q / z)[:, None] * seen - (n @ seen.T / z)[:, None] * W  # W follows the normal: dW = -(W.dn) n
    by_seen = outer(v, h_P) - h[:, None, None] * outer(normals, q_P)
    turned = -outer(n, W) - outer(normals, q_n) - q[:, None, None] * np.eye(3)
    by_normal = outer(v, h_n) + h[:, None, None] * turned
    by_index = (L * (1 - D / z) * N / root)[:, None] * v
    by_wedge = h[:, None, None] * (np.eye(3) - outer(normals, seen) / z[:, None, None])
    by_centre = outer((L * g / z)[:, None] * v, normals)
    return h[:, None] * v, by_seen, by_normal, by_index, by_wedge, by_centre
