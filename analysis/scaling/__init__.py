"""Bulk runs measured: what workers and nodes that die cost, how fast they read, and what a second run costs."""
