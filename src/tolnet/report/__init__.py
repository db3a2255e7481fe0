"""Tell: tolerance tables for people, differences between them, and maps of the network."""

from tolnet.report.map import tolerance_map

__all__ = ["tolerance_map"]
