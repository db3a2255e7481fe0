"""Tell: tables, documents and pictures for people and programs, and differences between tables."""

from tolnet.report.charts import performance_figure, simulation_figure
from tolnet.report.map import tolerance_map

__all__ = ["performance_figure", "simulation_figure", "tolerance_map"]
