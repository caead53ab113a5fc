"""Numbers that loops share with their counterparts in numpy; part of the machine code, so they stand in this folder.

A word of 64 bits holds three bytes, 21 bits apart (`rain.words`); a quad, of 32 bits, up to four (`compiled.quads`).
"""

FIELD = 21  # bits of a channel in a word
PACKED = 3  # channels in a word
EVERY = 1 + (1 << FIELD) + (1 << (2 * FIELD))
BELOW = 128  # gray levels below 0 that a sum has room for: weights can be negative
QUARTERS, COLUMNS, ROWS = 0, 1, 2
"""How a copy of an image is made of another: means over 2 x 2 texels, over pairs of columns, over pairs of rows."""
DRAW, COUNT, FILL = 0, 1, 2
"""What the loops over caps do: draw a frame, count its pixels and taps, or write them down."""
LANES = 8  # pixels whose taps are summed together
PLACES = 1 << 16  # of a cell (`rain.cells`): a place takes 16 bits
MOST_RAYS = 1024  # of a pixel, that `ray_steps` has room for
