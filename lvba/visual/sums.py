"""Columns of the sums of an observation; see `lvba.kernels.photometric`."""

COST, COUNT, SQUARE, WEIGHTS = 9, 10, 11, 12
