"""Calibration by pages whose pilots alone are known."""
