"""Recalibration: a drifted device's geometry is fitted again on known pages, judged on others, and written as a bundle.

It works in a process of its own. This room imports `model`.
"""
