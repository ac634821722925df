"""Graphs that decode a page: one that is run once, or an estimator's, whose step is repeated."""

from lightpage.runtime.model.execution.estimator_graph import EstimatorGraph
from lightpage.runtime.model.execution.table_graph import TableGraph

PageGraph = TableGraph | EstimatorGraph
