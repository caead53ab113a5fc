"""Calibration on mrcal: boards, corners, solves through acrylic, their uncertainty and their verdict."""
