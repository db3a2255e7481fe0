"""Offline design of robust Kalman filters on sensor networks."""

__version__ = "0.1.0"
