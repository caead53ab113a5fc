"""The rig itself: the pump on its serial line, the pair of cameras, and what they record."""
