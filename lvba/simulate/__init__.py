"""Simulated recordings with known truth, to judge a bundle adjustment by."""

from lvba.simulate.simulation import simulate

__all__ = ["simulate"]
