"""Which pairs of a recording become a data set: measured, rejected for reasons, spread out, split without leaks."""
