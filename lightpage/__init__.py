"""The ground: devices, pages, recordings, waves, calibration, metrics and a simulator; no torch, no network."""
