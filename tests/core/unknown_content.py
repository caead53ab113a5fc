"""What a plan must say of pixels that show something beyond an image of 400 x 300."""

from rainstereo.types import Array, Mask


def check_unknown(unknown: Mask, source: Array, shown: Mask, deep: Mask) -> None:
    """source: (H, W, 2) exact places. shown: pixels whose middle shows the scene; deep: those showing nothing else."""
    outside = shown & ((source < -2) | (source > [401, 301])).any(-1)
    within = deep & ((source > 40) & (source < [359, 259])).all(-1)
    assert outside.any()
    assert unknown[outside].all()
    assert not unknown[within].any()
