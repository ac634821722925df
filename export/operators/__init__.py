"""Operators of execution providers by version and type, and the nodes of a graph that they lack."""
