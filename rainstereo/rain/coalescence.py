"""Drops that have become one and come to rest: a round drop of their volume."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from rainstereo.droplet import cap_volume

from .contacts import clusters, groups, touching
from .drops import Drops


def coalesced(members: Drops) -> Drops:
    """The one drop that members become in the end, as a table of one: their volume at its centroid.

    Its contact angle is their mean, weighted by volume; its id that of the largest, its birth that of the oldest.
    """
    if not len(members):
        raise ValueError("no drops were given to coalesce; expected at least one")
    volume = float(members.volume.sum())
    weight = members.volume / volume
    angle = float(weight @ members.contact_angle)
    return replace(
        members.take([int(np.argmax(weight))]),
        x=np.array([weight @ members.x]),
        y=np.array([weight @ members.y]),
        radius=np.array([math.cbrt(volume / cap_volume(1.0, angle))]),
        contact_angle=np.array([angle]),
        birth=np.array([members.birth.min()]),
    )


def run_together(drops: Drops, overlap: float = 0.8) -> Drops:
    """The drops after those that cover one another far have become one; the others as given.

    overlap: two do so where their centres are closer than this share of the sum of their contact radii; 1: as soon as
    they touch. Repeated, since the drop that they become may cover others. Volume is conserved; the wet area shrinks.
    """
    if not 0 < overlap <= 1:
        raise ValueError(f"an overlap of {overlap} was given; expected a share of the sum of both radii, 0 to 1")
    while True:
        pairs = touching(drops.x, drops.y, overlap * drops.radius)
        if not len(pairs[0]):
            return drops
        together = groups(clusters(len(drops), *pairs))
        alone = np.ones(len(drops), dtype=np.bool_)
        for group in together:
            alone[group] = False
        drops = Drops.joined([drops.take(alone), *(coalesced(drops.take(group)) for group in together)])
