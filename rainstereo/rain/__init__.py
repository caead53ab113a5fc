"""Rain on a pane: what falls on it, how drops merge, move and leave streaks, and the picture of it."""
